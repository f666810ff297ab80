"""Named random streams, so that two terms never share numbers and forward and backward mode always do."""

from __future__ import annotations

from enum import IntEnum

import drjit as dr
import mitsuba as mi

from .varying import varying


class Stream(IntEnum):
    """One entry per independent consumer of random numbers; the value enters the seed, so never reuse one."""

    CAMERA = 0
    INTERIOR = 3
    PRIMARY_EDGE = 1
    PRIMARY_RADIANCE = 2
    DIRECT_EDGE = 4
    DIRECT_SUBPATH = 5
    INDIRECT_EDGE = 6
    INDIRECT_SUBPATH = 7
    INDIRECT_RADIANCE = 8
    LIGHT_STEP = 9
    LIGHT_STEP_SUBPATH = 10
    CHAIN_LINE = 11
    CHAIN_LOBES = 12
    CHAIN_CUTS = 13
    CHAIN_RADIANCE = 14
    CHAIN_GUIDE = 15
    HORIZON = 16
    HORIZON_SUBPATH = 17
    HORIZON_VIEW = 18
    LIGHT_SUBPATH = 19
    LIGHT_CHAIN = 20
    LIGHT_CHAIN_PILOT = 21
    SPHERE_RIMS = 22
    SPHERE_RIM_PATHS = 23
    LIGHT_HORIZON = 24
    LIGHT_HORIZON_SUBPATH = 25
    FILM_BORDER = 26


def other_seed(seed: int | mi.UInt32, key: int) -> mi.UInt32:
    """A seed for random numbers that are independent of those of `seed`, by `key`."""
    stored = varying(mi.UInt32, seed) if isinstance(seed, int) else mi.UInt32(seed)
    derived = mi.sample_tea_32(stored, varying(mi.UInt32, key))[0]
    dr.make_opaque(derived)
    return derived


def stream_seed(seed: int | mi.UInt32, stream: Stream) -> mi.UInt32:
    """Seed of `stream` derived from the user's `seed` (TEA hash), an opaque `UInt32` of width 1."""
    derived = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(int(stream)))[0]
    dr.make_opaque(derived)  # a literal would compile one kernel per seed
    return derived
