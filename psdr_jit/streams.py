"""Named random streams, so that two terms never share numbers and forward and backward mode always do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi


class Stream(IntEnum):
    """One entry per independent consumer of random numbers; the value enters the seed, so never reuse one."""

    CAMERA = 0
    INTERIOR = 3  # not the camera's: Mitsuba's samplers hash (seed, lane) as `lane_sampler` does
    PRIMARY_EDGE = 1
    PRIMARY_RADIANCE = 2
    DIRECT_EDGE = 4
    DIRECT_SUBPATH = 5
    INDIRECT_EDGE = 6
    INDIRECT_SUBPATH = 7
    INDIRECT_RADIANCE = 8


def stream_seed(seed: int | mi.UInt32, stream: Stream) -> mi.UInt32:
    """Seed of `stream` derived from the user's `seed` (TEA hash), an opaque `UInt32` of width 1."""
    derived = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(int(stream)))[0]
    dr.make_opaque(derived)  # a literal would compile one kernel per seed
    return derived


@dataclass
class LaneSampler:
    """Independent PCG32 random numbers, one sequence per lane; a PyTree that can be loop state.

    Mitsuba's samplers seed lanes consecutively; boundary terms need lanes that *share* a sequence
    (common random numbers on both sides of an edge), hence this small interface of the same names.
    """

    state: mi.PCG32

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        return self.state.next_float(mi.Float, active)

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        return mi.Point2f(self.next_1d(active), self.next_1d(active))


def lane_sampler(seed: mi.UInt32, lane: mi.UInt32) -> LaneSampler:
    """Sampler whose lanes follow the sequence number `lane` (equal numbers: equal sequences)."""
    init_state, init_seq = mi.sample_tea_32(seed, lane)
    return LaneSampler(mi.PCG32(1, mi.UInt64(init_state), mi.UInt64(init_seq)))
