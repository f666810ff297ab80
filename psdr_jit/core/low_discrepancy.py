"""Scrambled (0, 2)-sequences: well spread random numbers of which any lane can compute any dimension.

Sample i of dimension pair d is point i of the two-dimensional Sobol sequence, its digits scrambled by a nested random
permutation [Owen 1995], with the permutation computed by a hash [Laine and Karras 2011; Burley 2020, JCGT 9(4)].
Every dimension pair shuffles the order of the points by another nested permutation: pairs are independent, yet each
aligned block of 2^k consecutive lanes still is a stratified set in every pair. Where lanes are sorted along an edge
or by pixel, samples are therefore spread over all dimensions *within* each stretch of edge and each pixel.

Every number is uniform and independent from seed to seed, so estimates are unbiased and seeds may be averaged.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: 2^-24: the upper 24 bits of a 32-bit integer as a number in [0, 1).
_ULP = 2.0**-24

#: Odd numbers added to keys (fractional parts of the golden ratio, of √2 and of √3).
_NEXT_DIMENSION = 0x9E3779B9
_ORDER_KEY = 0x6A09E667
_ASIDE_KEY = 0xBB67AE85


def _mixed(x: mi.UInt32) -> mi.UInt32:
    """Finaliser of MurmurHash3: one bit of the input changes half of the bits of the output."""
    x = x ^ (x >> 16)
    x = x * 0x85EBCA6B
    x = x ^ (x >> 13)
    x = x * 0xC2B2AE35
    return x ^ (x >> 16)


def _nested_permutation(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Random permutation in which the flip of a bit depends on the *lower* bits only [Burley 2020, Listing 3]."""
    x = x + key
    x = x ^ (x * 0x6C50B47C)
    x = x ^ (x * 0xB82F1E52)
    x = x ^ (x * 0xC7AFE638)
    x = x ^ (x * 0x8D22F6E6)
    return x


def shuffled(i: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Random permutation of indices that maps aligned blocks of 2^k to aligned blocks, for every k."""
    return dr.brev(_nested_permutation(dr.brev(i), key))


def _second_digits(i: mi.UInt32) -> mi.UInt32:
    """Digits, last one first, of point i in the second Sobol dimension: Pascal's triangle modulo 2 times those of i.

    The matrix is a fivefold Kronecker power of [[1, 1], [0, 1]], hence five steps.
    """
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        i = i ^ ((i & mask) >> shift)
    return i


def _fraction(digits: mi.UInt32, key: mi.UInt32) -> mi.Float:
    """Owen-scrambled number in [0, 1) whose binary digits, last one first, are `digits`."""
    return mi.Float(dr.brev(_nested_permutation(digits, key)) >> 8) * _ULP


@dataclass
class LaneSampler:
    """Random numbers of many lanes; a PyTree that can be loop state. Lanes of equal index and key draw equal numbers.

    `key` has the lanes' width or 1. The interface is that of Mitsuba's samplers, as far as `walk` and `sample_rays`
    need it.
    """

    index: mi.UInt32  # position in the sequence
    key: mi.UInt32  # which sequence; changes with every call

    def _advance(self) -> None:
        self.key = self.key + _NEXT_DIMENSION

    def aside(self, number: mi.UInt32, where: mi.Bool) -> LaneSampler:
        """A sampler whose numbers are others in the lanes `where`, by `number`, and this one's elsewhere."""
        return LaneSampler(mi.UInt32(self.index), dr.select(where, _mixed(self.key ^ (number + _ASIDE_KEY)), self.key))

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        key = _mixed(self.key)
        self._advance()
        return _fraction(shuffled(self.index, key ^ _ORDER_KEY), key)

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        key = _mixed(self.key)
        self._advance()
        i = shuffled(self.index, key ^ _ORDER_KEY)
        return mi.Point2f(_fraction(i, key), _fraction(_second_digits(i), _mixed(key)))


def lane_sampler(seed: mi.UInt32, lane: mi.UInt32) -> LaneSampler:
    """One sequence for all lanes, in the order of `lane`: for samples that are sorted along the edges."""
    return LaneSampler(mi.UInt32(lane), mi.UInt32(seed))
