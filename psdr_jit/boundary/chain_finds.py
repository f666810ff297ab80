"""Where searches leave what they find (`chain_search`): crossings, and intervals that are gone on with later."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from .chain_intervals import Crossing, Interval

#: Most crossings that a search finds in one kernel, and most intervals that it comes back to; and where there are more
#: searches than FEW.
SLOTS, MANY_SLOTS, FEW = 8, 2, 16384


class Finds:
    """What the searches of a queue find, with what they leave for later. Not a PyTree."""

    def __init__(self, queue):
        size = dr.width(queue.at.sample)
        slots = SLOTS if size <= FEW else MANY_SLOTS
        self.stride, self.slots = varying(mi.UInt32, size), varying(mi.UInt32, slots)
        n = size * slots
        self.crossing = Crossing(Interval.made(dr.zeros, n), dr.zeros(mi.UInt32, n))
        self.before = Interval.made(dr.zeros, n)
        self.found, self.goes_on = dr.zeros(mi.Bool, n), dr.zeros(mi.Bool, n)
        self.rest = dr.zeros(type(queue), size)
        self.segments = dr.zeros(mi.UInt32, size)
        dr.make_opaque(self.arrays)

    @property
    def arrays(self) -> list:
        """What kernels fill."""
        return [self.crossing, self.before, self.found, self.goes_on, self.rest, self.segments]

    def write(self, task: mi.UInt32, slot: mi.UInt32, kept: mi.Bool, crossing: Crossing, active: mi.Bool) -> None:
        """A crossing, and whether it is kept."""
        self._scatter(task, slot, ((self.crossing, crossing), (self.found, kept)), active)

    def leave(self, task: mi.UInt32, rest, stack: Stack, height: mi.UInt32, segments: mi.UInt32, done: mi.Bool) -> None:
        """How far a search has come, and what it has not come back to."""
        dr.scatter(self.rest, rest, task, done, mode=dr.ReduceMode.Permute)
        dr.scatter(self.segments, segments, task, done, mode=dr.ReduceMode.Permute)
        for i in range(SLOTS):
            number = mi.UInt32(i)
            front = read(stack, number, rest.at.sample)
            pairs = (self.before, front), (self.goes_on, mi.Bool(True))
            self._scatter(task, number, pairs, done & (number < height))

    def _scatter(self, task: mi.UInt32, slot: mi.UInt32, pairs: tuple, active: mi.Bool) -> None:
        active = active & (slot < self.slots)
        for buffer, value in pairs:
            dr.scatter(buffer, value, slot * self.stride + task, active, mode=dr.ReduceMode.Permute)


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
