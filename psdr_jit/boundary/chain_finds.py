"""Where searches leave what they find (`chain_search`): crossings, and intervals that are gone on with later."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from .chain_intervals import Crossing, Interval

#: Most crossings that a search finds in one kernel, and most intervals that it comes back to.
SLOTS = 8


class Finds:
    """Crossings of `lanes` searches, up to `slots` each, with what lies in front of each. Not a PyTree."""

    def __init__(self, lanes: int, slots: int):
        self.stride, self.lane = varying(mi.UInt32, lanes), dr.arange(mi.UInt32, lanes)
        self.slots = varying(mi.UInt32, slots)
        n = lanes * slots
        self.crossing = Crossing(Interval.made(dr.zeros, n), dr.zeros(mi.UInt32, n))
        self.before = Interval.made(dr.zeros, n)
        self.found, self.goes_on = dr.zeros(mi.Bool, n), dr.zeros(mi.Bool, n)
        dr.make_opaque(self.crossing, self.before, self.found, self.goes_on)

    def write(self, slot: mi.UInt32, kept: mi.Bool, crossing: Crossing, active: mi.Bool) -> None:
        """A crossing, and whether it is kept."""
        active = active & (slot < self.slots)
        self._scatter(slot, ((self.crossing, crossing), (self.found, kept)), active)

    def write_front(self, slot: mi.UInt32, front: Interval, active: mi.Bool) -> None:
        """An interval in front of a crossing that a later kernel goes on with."""
        active = active & (slot < self.slots)
        self._scatter(slot, ((self.before, front), (self.goes_on, mi.Bool(True))), active)

    def _scatter(self, slot: mi.UInt32, pairs: tuple, active: mi.Bool) -> None:
        for buffer, value in pairs:
            dr.scatter(buffer, value, slot * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def write_rest(self, stack: Stack, height: mi.UInt32, sample: mi.UInt32) -> None:
        """What searches of the lines `sample` that pause have not come back to."""
        for i in range(SLOTS):
            number = mi.UInt32(i)
            self.write_front(number, read(stack, number, sample), number < height)


#: A stack of intervals: bounds, weight and whether they are fresh; key. One place more than it holds takes what is
#: written nowhere: masks of `dr.Local` are not to be relied on (Dr.Jit 1.5, LLVM).
Stack = tuple[dr.Local, dr.Local]


def empty_stack() -> Stack:
    return dr.alloc_local(mi.Vector4f, SLOTS + 1), dr.alloc_local(mi.UInt32, SLOTS + 1)


def push(stack: Stack, height: mi.UInt32, at: Interval, active: mi.Bool) -> mi.UInt32:
    """The height afterwards."""
    marks = dr.select(at.fresh, mi.Float(1), 0) + dr.select(at.uneven, mi.Float(2), 0)
    for store, value in zip(stack, (mi.Vector4f(at.lo, at.hi, at.weight, marks), at.key), strict=True):
        store.write(value, dr.select(active, height, SLOTS))
    return height + dr.select(active, mi.UInt32(1), 0)


def read(stack: Stack, i: mi.UInt32, sample: mi.UInt32) -> Interval:
    """Number `i`, from the bottom; all are of the line `sample`."""
    (lo, hi, weight, marks), key = (store.read(i) for store in stack)
    fresh = (marks == 1) | (marks == 3)
    return Interval(sample, lo, hi, weight, key, fresh, marks >= 2)
