"""Arrays of many shapes as one, without a kernel for every number of them.

`dr.concat` of n arrays is n scatters with constants of their own: one kernel that LLVM compiles for seconds where n is
300, and for half a minute where it is 1000.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .upload import uploaded
from .varying import varying

#: Arrays up to which they are joined on the device.
FEW = 8

#: Bytes of joined arrays that are kept, and as many of those they are made of: a kept array is replaced when it is
#: written to, so that its index stands for its values. A call joins about ten.
KEPT = 1 << 26
BYTES = 4  # of an entry
_JOINED: OrderedDict[tuple, tuple[list, Any]] = OrderedDict()


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
    """What is attached is read anew; all else only if it was not among what was joined last."""
    moves = [dr.grad_enabled(array) for array in arrays]
    still = [dr.detach(array) for array, own in zip(arrays, moves, strict=True) if not own]
    key = (kind, *(-dr.width(array) if own else array.index for array, own in zip(arrays, moves, strict=True)))
    if key in _JOINED:
        _JOINED.move_to_end(key)
        whole = _JOINED[key][1]
    else:
        whole = uploaded(kind, np.concatenate([np.array(dr.detach(array)).ravel() for array in arrays]))
        _JOINED[key] = (still, whole)
        while BYTES * sum(dr.width(known) for _, known in _JOINED.values()) > KEPT:
            _JOINED.popitem(last=False)
    result, start = kind(whole), 0
    for array, own in zip(arrays, moves, strict=True):
        size = dr.width(array)
        if own:
            place = dr.arange(mi.UInt32, size) + varying(mi.UInt32, start)
            dr.scatter(result, array, place, mode=dr.ReduceMode.Permute)
        start += size
    return result


def joined_points(kind: type, arrays: Sequence[Any]) -> Any:
    """Flat arrays of coordinates one after the other, as points, vectors or normals of type `kind`."""
    flat = joined(arrays)
    return dr.gather(kind, flat, dr.arange(mi.UInt32, dr.width(flat) // 3))


def starts(counts: Sequence[int]) -> np.ndarray:
    """Where each of several runs with so many entries begins."""
    return np.cumsum(counts) - counts


def pointers(kind: type, objects: Sequence[Any]) -> Any:
    """Pointers of type `kind` (`mi.ShapePtr`, ...) to `objects`, at least one of them; one entry each."""
    objects = list(objects)
    return kind(objects) if len(objects) > 1 else kind(objects[0])  # an array of one would be no literal
