"""Arrays of many shapes as one, without a kernel for every number of them.

`dr.concat` of n arrays is n scatters with constants of their own: one kernel that LLVM compiles for seconds where n is
300, and for half a minute where it is 1000.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .upload import uploaded

#: Arrays up to which they are joined on the device.
FEW = 8


def joined(arrays: Sequence[Any]) -> Any:
    """Flat arrays of one type one after the other, attached where they are: of many, evaluated and by way of the host.

    Masks as well; those are detached.
    """
    arrays = list(arrays)
    kind = type(arrays[0])
    if len(arrays) == 1:
        return kind(arrays[0])
    if len(arrays) > FEW:
        return _by_host(kind, arrays)
    if dr.is_mask_v(kind):  # concatenation moves numbers, not bits
        return dr.concat([dr.select(array, mi.UInt32(1), 0) for array in arrays]) != 0
    return dr.concat(arrays)


def _by_host(kind: type, arrays: list[Any]) -> Any:
    result = uploaded(kind, np.concatenate([np.array(dr.detach(array)).ravel() for array in arrays]))
    start = 0
    for array in arrays:
        size = dr.width(array)
        if dr.grad_enabled(array):
            dr.scatter(result, array, dr.arange(mi.UInt32, size) + start, mode=dr.ReduceMode.Permute)
        start += size
    return result


def pointers(kind: type, objects: Sequence[Any]) -> Any:
    """Pointers of type `kind` (`mi.ShapePtr`, ...) to `objects`, at least one of them; one entry each."""
    objects = list(objects)
    return kind(objects) if len(objects) > 1 else kind(objects[0])  # an array of one would be no literal
