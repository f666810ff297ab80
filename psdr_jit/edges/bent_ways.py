"""Ways across patches on which the curves are met where bent normals turn from a viewpoint.

h = n·(o − x)/|o − x| is smooth within a texel (`bent_texels`), and is looked at there only: normals of a bump map step
at its borders. A way crosses a triangle in b of which one corner, A, is alone on its side of h = 0. It is r (E(s) − A),
from there to a point of the opposite side, and has one root. The triangle is

- the patch, where it is small, h has different signs at its corners, and normals do not step on it;
- else one of those into which the part of a texel is cut that lies in the box of the patch. t picks the texel, with
  probability p (`bent_cells`), and one of the n triangles at whose corners h has different signs.

With the double area a of the triangle in b, ways meet a curve, per area of b and change of h, with the density

    D = p/n |∇_b h·(E − A)| / (r a),

as |∂b/∂s × ∂b/∂r| = r a. Triangles with one sign at all corners are taken to have no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .bent_cells import SMALL, Cell
from .bent_rows import BentRows
from .bent_surface import BentSurface
from .bent_texels import Texels, beside, those_that
from .shading_curve import LoneCorner

#: A texel is cut into twice the square of this number of triangles.
CUTS = 4

#: Probability of a texel below which too little is left of t to say where on it.
FEW_BITS = 2.0**-10

#: Least slope that counts, relative to the mean one: a curve that touches a way for once is given up to this.
FLATTEST = 0.1


@dataclass
class Way:
    """From a corner to the opposite side of a triangle, in b."""

    start: mi.Point2f
    along: mi.Vector2f
    h: tuple[mi.Float, mi.Float]  # cosine between the bent normal and the direction to the viewer at both ends, about
    exists: mi.Bool
    density: mi.Float  # p/(n a)

    def met(self, r: mi.Float, slope: mi.Vector2f) -> mi.Float:
        """Density D of ways at the share r of this one, per change of h; `slope`: ∂h/∂b."""
        least = FLATTEST * dr.abs(self.h[1] - self.h[0])
        return dr.maximum(dr.abs(dr.dot(slope, self.along)), least) * self.density / r


def way_across(
    surface: BentSurface, rows: BentRows, t: mi.Float, cell: Cell, view: mi.Vector4f, active: mi.Bool
) -> Way:
    """On which the curve is looked for on a patch; t, which has picked the `cell`, picks it."""

    def heights(corners: list[mi.Point2f], asked: mi.Bool) -> list[mi.Float]:
        return [surface.height(rows, bent, view) for bent in surface.bent_at(rows, corners, asked)]

    texels = Texels.of(rows)
    small = (rows.texels <= SMALL) & (~rows.steps | (texels.all.count == 1))
    patch = [mi.Point2f(0, 0), mi.Point2f(1, 0), mi.Point2f(0, 1)]
    whole = ~texels.has_area | (small & _differ([h > 0 for h in heights(patch, active & small)]))
    grid = _Grid.of(surface, rows, texels, cell, view, active & ~whole)
    left = cell.t * mi.Float(grid.number)
    chosen = dr.minimum(mi.UInt32(left), dr.maximum(grid.number, 1) - 1)
    other = mi.sample_tea_float32(dr.reinterpret_array(mi.UInt32, t), rows.part)
    left = dr.select(cell.pmf < FEW_BITS, other, left - mi.Float(chosen))
    s = dr.clip(dr.select(whole, t, left), 0, dr.one_minus_epsilon(mi.Float))
    triangle = grid.corners(grid.triangle(chosen, active & ~whole))
    corners = [mi.Point2f(dr.select(whole, a, b)) for a, b in zip(patch, triangle, strict=True)]
    h = heights(corners, active)
    up = [value > 0 for value in h]
    lone = LoneCorner.of(up)
    a, e = (lone.at(s, mi.Float(r)) for r in (0, 1))
    start, end = (mi.Point2f(_blended(corners, b)) for b in (a, e))
    density = dr.select(whole, 1, cell.pmf / (mi.Float(grid.number) * grid.double_area))
    exists = active & _differ(up) & (whole | (grid.number > 0))
    return Way(start, mi.Vector2f(end - start), (_blended(h, a), _blended(h, e)), exists, density)


def on_patch(b: mi.Point2f) -> mi.Bool:
    """Is b a point of the patch?"""
    return (b.x >= 0) & (b.y >= 0) & (b.x + b.y <= 1)


def _blended(values: list, b: mi.Point2f):
    return values[0] + b.x * (values[1] - values[0]) + b.y * (values[2] - values[0])


def _differ(up: list[mi.Bool]) -> mi.Bool:
    return (up[0] != up[1]) | (up[0] != up[2])


@dataclass
class _Grid:
    """The part of a texel, cut into squares and each of these into two triangles."""

    texels: Texels
    cell: Cell
    up: mi.UInt32  # bit by corner of the squares: is h > 0?
    number: mi.UInt32  # of triangles at whose corners it has different signs

    @staticmethod
    def of(
        surface: BentSurface, rows: BentRows, texels: Texels, cell: Cell, view: mi.Vector4f, active: mi.Bool
    ) -> _Grid:
        width = dr.width(cell.low, cell.t)
        grid = _Grid(texels, cell, dr.zeros(mi.UInt32, width), mi.UInt32(0))

        def look(k: mi.UInt32, up: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
            above = surface.height(rows, surface.bent(rows, grid.at(k), active), view) > 0
            return k + 1, up | dr.select(above, mi.UInt32(1) << k, 0)

        goes_on = lambda k, up: active & (k < (CUTS + 1) ** 2)  # noqa: E731
        state = dr.zeros(mi.UInt32, width), grid.up
        grid.up = dr.while_loop(state, goes_on, look, label="where bent normals turn away")[1]
        grid.number = grid._crossed(mi.UInt32(2 * CUTS**2), active)[1]
        return grid

    @property
    def double_area(self) -> mi.Float:
        """Of a triangle, in b."""
        size = self.cell.high - self.cell.low
        return size.x * size.y / (CUTS**2 * self.texels.area)

    def at(self, corner: mi.UInt32) -> mi.Point2f:
        """b of a corner of the squares."""
        place = mi.Point2f(mi.Float(corner % (CUTS + 1)), mi.Float(corner // (CUTS + 1))) / CUTS
        return self.texels.inside(self.cell.low, self.cell.high, place)

    def corners(self, triangle: mi.UInt32) -> list[mi.Point2f]:
        return [self.at(corner) for corner in self._numbers(triangle)]

    def triangle(self, which: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Of those with different signs, the one so many places after the first."""
        return dr.maximum(self._crossed(which, active)[0], 1) - 1

    def _numbers(self, triangle: mi.UInt32) -> list[mi.UInt32]:
        square, upper = triangle >> 1, (triangle & 1) != 0
        first = square + square // CUTS
        other = first + CUTS + 1
        return [dr.select(upper, other + 1, first), first + 1, other]

    def _crossed(self, before: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Those with different signs, and a part of the patch: see `those_that`."""

        def fits(triangle: mi.UInt32) -> mi.Bool:
            differs = _differ([(self.up >> k) & 1 != 0 for k in self._numbers(triangle)])
            return differs & ~beside(self.corners(triangle))

        return those_that(fits, mi.UInt32(2 * CUTS**2), before, active)
