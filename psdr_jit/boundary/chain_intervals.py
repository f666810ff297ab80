"""Parts of lines that are searched for crossings, and the chances by which they are looked into (`chain_search`).

The ends of an interval agree, but two crossings inside may hide each other. A chain from a place m inside is compared
with that from the near end. Where they differ, both sides of m hold crossings and both are searched, with the weight
that the interval has: the edges of something thin are found together, and as it moves, what the one brings and what the
other does nearly cancel. Where they agree, one of the two sides, by its width, is looked into with probability s, and
its weight grows as its width shrinks and by 1/s. So every crossing is found with expected weight 1, whatever chains are
taken to agree: which side is chosen has no say in what is compared. Its far end is not compared again, but where a step
that rests lies there, which the search has walked around in a wide bend: what moves in the bend would be found late,
and with much weight. What is narrower by a factor 2 is found with 2/s times the weight, and by so many fewer lines that
each such factor adds 1/s times as much to the variance: few intervals are looked into at first, and then nearly all,
down to what is too narrow to matter.

Small and bright lamps are what matters most, and of them one can tell where they hide (`chain_lamps`): m is that place,
and the interval is always looked into. Elsewhere m lies about the middle, at random.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: With which probability an interval is looked into: if its ends see a delta lobe, at first and further inside; and
#: elsewhere.
GO_ON, GO_ON_AGAIN, GO_ON_ELSEWHERE = 0.3, 0.95, 0.1

#: By up to which share of the width, in all, the place in the middle is moved at random.
CUT_SPREAD = 0.3

#: What random numbers of an interval are for; and which part of it another one is.
KEPT, CUT, SIDE = range(3)
FRONT, BEHIND, HALF = range(3)


@dataclass
class Interval:
    """A part of a line. Detached."""

    sample: mi.UInt32  # number of the line
    lo: mi.Float
    hi: mi.Float
    weight: mi.Float
    key: mi.UInt32  # of its random numbers
    fresh: mi.Bool  # its ends have not been compared
    uneven: mi.Bool  # they may differ, though what is between them is looked into as if they agreed

    @staticmethod
    def made(make, size: int) -> Interval:
        """`size` of them by `make`, see `Hit.made`."""
        floats, masks = (make(mi.Float, size) for _ in range(3)), (make(mi.Bool, size) for _ in range(2))
        return Interval(make(mi.UInt32, size), *floats, make(mi.UInt32, size), *masks)

    @staticmethod
    def whole(sample: mi.UInt32, key: mi.UInt32) -> Interval:
        """The lines `sample` from end to end."""
        n = dr.width(sample)
        lo, hi, weight = dr.zeros(mi.Float, n), dr.ones(mi.Float, n), dr.ones(mi.Float, n)
        return Interval(sample, lo, hi, weight, key, dr.ones(mi.Bool, n), dr.zeros(mi.Bool, n))

    @property
    def width(self) -> mi.Float:
        return self.hi - self.lo

    def part(self, lo: mi.Float, hi: mi.Float, which: int, fresh: mi.Bool, uneven: mi.Bool) -> Interval:
        """The part from `lo` to `hi`, with the same weight; `which` is part of its key."""
        key = mi.sample_tea_32(self.key, 1 + which)[1]
        return Interval(self.sample, lo, hi, self.weight, key, mi.Bool(fresh), mi.Bool(uneven))

    def middle(self) -> mi.Float:
        """A place about the middle."""
        return dr.lerp(self.lo, self.hi, 0.5 + CUT_SPREAD * (self._uniform(CUT) - 0.5))

    def half(self, cut: mi.Float) -> Interval:
        """One of the parts that a cut makes, by their widths. Its near end agrees with that of the interval."""
        behind = self._uniform(SIDE) * self.width < self.hi - cut
        lo, hi = dr.select(behind, cut, self.lo), dr.select(behind, self.hi, cut)
        uneven = self.uneven & behind
        half = self.part(lo, hi, HALF, uneven, uneven)
        half.weight = self.weight * dr.select(half.width > 0, self.width / half.width, 0)
        return half

    def kept(self, specular: mi.Bool, sure: mi.Bool, narrowest: float) -> tuple[mi.Bool, Interval]:
        """`(is it looked into, as what)`: an interval whose ends agree, whether or not they see a delta lobe.

        What is fresh is looked at first, and what is `sure` in any case.
        """
        share = dr.select(specular, dr.select(self.weight == 1, mi.Float(GO_ON), GO_ON_AGAIN), GO_ON_ELSEWHERE)
        share = dr.select(sure | self.fresh, 1, share)
        kept = (self.width > narrowest) & (self._uniform(KEPT) < share)
        weight, fresh, uneven = self.weight / share, mi.Bool(self.fresh), mi.Bool(self.uneven)
        return kept, Interval(self.sample, self.lo, self.hi, weight, self.key, fresh, uneven)

    def _uniform(self, which: int) -> mi.Float:
        return mi.Float(mi.sample_tea_32(self.key, mi.UInt32(which))[0] >> 8) * 2.0**-24


@dataclass
class Crossing:
    """An interval too short to be cut, whose ends see different surfaces at segment k. Detached."""

    at: Interval
    k: mi.UInt32
