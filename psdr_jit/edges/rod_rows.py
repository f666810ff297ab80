"""Pieces of the edges of linear curves: outlines of their sides and end spheres, and creases at their joints."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..scene.surfaces import NONE, Rods

#: Rows of a side, of an end sphere, and of a crease: hidden or distant parts get their own weight.
SIDE_PIECES, END_PIECES, CREASE_PIECES = 4, 8, 2

#: What a row is a piece of.
SIDE, END, CREASE = range(3)


@dataclass
class RodRows:
    """One entry per piece; detached device arrays."""

    part: mi.UInt32  # SIDE, END or CREASE; of a crease, between `segment` and the next
    segment: mi.UInt32
    previous: mi.UInt32  # the segment before it on the same curve, or NONE ...
    next: mi.UInt32  # ... and the one after it
    start: mi.Float  # v, turns or parameter of the crease at which it begins ...
    length: mi.Float  # ... and how far it goes
    side: mi.Float  # of a side: ±1; of an end: −1 at v = 0, 1 at v = 1
    moves: mi.Bool


def rod_rows(rods: Rods) -> RodRows:
    """Pieces of all linear curves."""
    first, owner = (np.array(a).astype(np.int64) for a in (rods.first, rods.owner))
    segment = np.arange(len(first))
    joined = (np.diff(first) == 1) & (np.diff(owner) == 0)
    previous = np.where(np.append(False, joined), segment - 1, NONE)
    following = np.where(np.append(joined, False), segment + 1, NONE)
    columns = []
    for side in (-1, 1):
        columns += _pieces(SIDE, segment, SIDE_PIECES, side)
    columns += _pieces(END, segment[previous == NONE], END_PIECES, -1)
    columns += _pieces(END, segment, END_PIECES, 1)  # a joint's sphere is that of the segment before it
    columns += _pieces(CREASE, segment[following != NONE], CREASE_PIECES, 1)
    part, of, *floats = (np.concatenate(c) for c in zip(*columns, strict=True))
    of = of.astype(np.int64)
    ints = (part, of, previous[of], following[of])
    moves = np.array(rods.moves)[owner][of]
    return RodRows(
        *(uploaded(mi.UInt32, a.astype(np.uint32)) for a in ints),
        *(uploaded(mi.Float, a) for a in floats),
        uploaded(mi.Bool, moves),
    )


def _pieces(part: int, segment: np.ndarray, count: int, side: int) -> list[tuple[np.ndarray, ...]]:
    def full(value: float) -> np.ndarray:
        return np.full(len(segment), value, float)

    return [(full(part), segment, full(k / count), full(1 / count), full(side)) for k in range(count)]
