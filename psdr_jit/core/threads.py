"""Derivatives run in one thread at a time: Dr.Jit's graph of derivatives is one for all threads of a process.

Two threads that record or traverse it at once get each other's edges: errors from inside of Dr.Jit, wrong gradients, or
the end of the process, with Mitsuba's own integrators as well.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, TypeVar

from psdr_jit.errors import UnsupportedError

Function = TypeVar("Function", bound=Callable[..., Any])

TURN = threading.RLock()  # held by the thread that differentiates


def one_at_a_time(function: Function) -> Function:
    """Calls of other threads wait until this one is over. For what does all that touches the graph itself."""

    @wraps(function)
    def waiting(*args: Any, **kwargs: Any) -> Any:
        with TURN:
            return function(*args, **kwargs)

    return waiting


@contextmanager
def alone() -> Iterator[None]:
    """Raises where another thread differentiates. For parts of what a caller does: to wait there would be too late."""
    if not TURN.acquire(blocking=False):
        raise UnsupportedError(
            "another thread is computing a derivative, and Dr.Jit keeps one graph for all threads: let each thread "
            "hold one threading.Lock from dr.enable_grad to the end of dr.backward, call psdr_jit.gradient, which "
            "waits, or use processes"
        )
    try:
        yield
    finally:
        TURN.release()
