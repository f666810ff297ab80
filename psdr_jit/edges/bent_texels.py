"""Where the texels of a map lie on a patch.

In *texel coordinates* w, the map is smooth between whole numbers: between the centres of texels of a bilinear bitmap,
on texels of a nearest-neighbour one. They are an affine function of b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .bent_rows import BentRows

#: Twice the area of a patch, relative to the square of its size in texels, below which it has none.
FLAT = 1e-6

#: How far inside of a texel its points stay [texels], in addition to rounding of w.
INSIDE, ROUNDING = 1e-4, 2.0**-21


@dataclass
class Block:
    """Texels side by side, one block per lane; whole numbers."""

    first: mi.Point2f
    number: mi.Point2f

    @property
    def count(self) -> mi.Float:
        return self.number.x * self.number.y

    def texel(self, which: mi.UInt32) -> Block:
        """Of all of them, the one with this number."""
        which = mi.Float(which)
        row = dr.floor((which + 0.5) / self.number.x)
        return Block(mi.Point2f(self.first + mi.Point2f(which - row * self.number.x, row)), mi.Point2f(1))


@dataclass
class Texels:
    """Texel coordinates of patches, one per lane."""

    w0: mi.Point2f  # at b = 0
    d1: mi.Vector2f  # their derivatives by b1 and b2
    d2: mi.Vector2f
    low: mi.Point2f  # the box of the patch
    high: mi.Point2f

    @staticmethod
    def of(rows: BentRows) -> Texels:
        low, high = (pick(pick(rows.w0, rows.w1), rows.w2) for pick in (dr.minimum, dr.maximum))
        d1, d2 = mi.Vector2f(rows.w1 - rows.w0), mi.Vector2f(rows.w2 - rows.w0)
        return Texels(rows.w0, d1, d2, mi.Point2f(low), mi.Point2f(high))

    @property
    def all(self) -> Block:
        """All that may hold a part of the patch."""
        first = dr.floor(self.low)
        return Block(mi.Point2f(first), mi.Point2f(dr.floor(self.high) - first + 1))

    @property
    def area(self) -> mi.Float:
        """|∂w/∂b|."""
        return dr.abs(self._determinant)

    @property
    def has_area(self) -> mi.Bool:
        return self.area > FLAT * dr.maximum(dr.squared_norm(self.d1), dr.squared_norm(self.d2))

    @property
    def _determinant(self) -> mi.Float:
        return self.d1.x * self.d2.y - self.d1.y * self.d2.x

    def of_point(self, b: mi.Point2f) -> mi.Point2f:
        return mi.Point2f(self.w0 + b.x * self.d1 + b.y * self.d2)

    def inside(self, low: mi.Point2f, high: mi.Point2f, place: mi.Point2f) -> mi.Point2f:
        """b of a place in a rectangle, given in [0, 1]²; also beside the patch."""
        w = mi.Point2f(low + place * (high - low))
        v, scale = w - self.w0, dr.rcp(self._determinant)
        return mi.Point2f(v.x * self.d2.y - v.y * self.d2.x, self.d1.x * v.y - self.d1.y * v.x) * scale

    def holds(self, block: Block) -> mi.Bool:
        """May a block hold a part of the patch?"""
        low, high = self.rectangle(block)
        corners = [self.inside(low, high, mi.Point2f(*place)) for place in ((0, 0), (1, 0), (1, 1), (0, 1))]
        return ~self.has_area | ~beside(corners)

    def rectangle(self, block: Block) -> tuple[mi.Point2f, mi.Point2f]:
        """The part of a block that lies in the box of the patch, and a little inside of its texels: `(low, high)`."""
        low = dr.maximum(block.first, self.low)
        high = dr.minimum(block.first + block.number, self.high)
        room = INSIDE + ROUNDING * dr.maximum(dr.abs(low), dr.abs(high))
        room = dr.minimum(room, (high - low) / 4)
        return mi.Point2f(low + room), mi.Point2f(high - room)


def those_that(
    fit: Callable[[mi.UInt32], mi.Bool], number: mi.UInt32, before: mi.UInt32, active: mi.Bool
) -> tuple[mi.UInt32, mi.UInt32]:
    """Of things 0, 1, … below `number`, those that `fit` are counted until there are more than `before`:
    `(where the count ended, how many)`. The thing that was counted last is the one before the end.
    """

    def goes_on(thing: mi.UInt32, found: mi.UInt32) -> mi.Bool:
        return active & (thing < number) & (found <= before)

    def look(thing: mi.UInt32, found: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        return thing + 1, found + dr.select(fit(thing), mi.UInt32(1), 0)

    width = dr.width(number, before, active)
    state = dr.zeros(mi.UInt32, width), dr.zeros(mi.UInt32, width)
    return dr.while_loop(state, goes_on, look, label="those that fit")


def beside(corners: list[mi.Point2f]) -> mi.Bool:
    """Do points b lie beside the patch, all of them beyond the same side?"""
    outside = [[b.x < 0 for b in corners], [b.y < 0 for b in corners], [b.x + b.y > 1 for b in corners]]
    found = mi.Bool(False)
    for beyond in outside:
        together = beyond[0]
        for each in beyond[1:]:
            together &= each
        found |= together
    return found
