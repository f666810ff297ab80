"""Numbers that differ from call to call, while the kernels that use them stay the same.

Dr.Jit writes a number that it knows while tracing into the code of the kernel: every sample count, radius or corner of
a box would compile a kernel of its own. A number that is stored first is read by the kernel instead. Whatever comes
from the host and may be another one in the next call (counts of lanes and samples, sizes and places of what moves)
therefore enters through `varying`; constants of the method do not, and cost nothing.
"""

from __future__ import annotations

from typing import Any, TypeVar

import drjit as dr

T = TypeVar("T")


def varying(kind: type[T], value: Any) -> T:
    """`value` (a number, or one for each component) as a stored array of type `kind` and width 1."""
    return dr.opaque(kind, value)
