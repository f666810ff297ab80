"""Nothing is collected while kernels are put together."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def nothing_collected() -> Iterator[None]:
    """Python's collector of reference cycles rests meanwhile.

    Dr.Jit writes a virtual call for all objects that are alive. A scene that waits in a cycle, as one that an exception
    has passed through, is alive until it is collected, at any allocation. Between two calls of one kernel that is too
    late: they differ in what they reach, the function of an object which both reach is written twice, and Dr.Jit ends
    the process ("invalid redefinition of function").
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
