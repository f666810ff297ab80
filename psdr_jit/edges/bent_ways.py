"""Ways across patches on which the curves are met where bent normals turn from a viewpoint.

Of a patch, t picks one of c² cells (`bent_cells`), with probability p. The cell is cut into k² triangles in b: k = 1
where it is small against a texel and h = n·(o − x)/|o − x| has one sign at two of its corners and another at the third.
Of those n of them at whose corners h has different signs, t picks one. With A the corner that is alone on its side, the
way is r (E(s) − A) from there to a point of the opposite side, and it has one root. Ways meet a curve, per area of b
and change of h, with the density

    D = p c² k²/n |∇_b h·(E − A)| / r,

as |∂b/∂s × ∂b/∂r| = r/(c k)². Triangles with one sign at all corners are taken to have no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .bent_cells import Cell, cell_corners
from .bent_looks import Corners
from .bent_rows import BentRows
from .bent_surface import BentSurface
from .shading_curve import LoneCorner

#: Size of cells, in texels, that need not be cut where the signs at their corners differ.
SMALL = 0.5

#: Triangles along the side of others: per texel, at least, and at most, as the signs at their corners fill 64 bits.
CUTS, LEAST_CUTS, MOST_CUTS = 4.0, 4.0, 9.0

#: Least slope that counts, relative to the mean one: a curve that touches a way for once is given up to this.
FLATTEST = 0.1


@dataclass
class Way:
    """From a corner to the opposite side of a triangle, in b."""

    start: mi.Point2f
    along: mi.Vector2f
    h: tuple[mi.Float, mi.Float]  # cosine between the bent normal and the direction to the viewer at both ends, about
    exists: mi.Bool
    density: mi.Float  # p c² k²/n

    def met(self, r: mi.Float, slope: mi.Vector2f) -> mi.Float:
        """Density D of ways at the share r of this one, per change of h; `slope`: ∂h/∂b."""
        least = FLATTEST * dr.abs(self.h[1] - self.h[0])
        return dr.maximum(dr.abs(dr.dot(slope, self.along)), least) * self.density / r


def way_across(surface: BentSurface, rows: BentRows, cell: Cell, view: mi.Vector4f, active: mi.Bool) -> Way:
    """On which the curve is looked for in a cell; `cell.t` picks it."""

    def heights(corners: Corners) -> list[mi.Float]:
        bent = surface.bent_at(rows, [corners.b0, corners.b1, corners.b2], active)
        return [surface.height(rows, each, view) for each in bent]

    texels = rows.texels / cell.per_side
    whole = _differ([h > 0 for h in heights(cell.corners)]) & (texels <= SMALL)
    wish = dr.maximum(dr.ceil(CUTS * texels), LEAST_CUTS)
    # of cells that are too large for one grid, a part
    parts = dr.select(whole, 1, dr.ceil(wish / MOST_CUTS))
    k = dr.select(whole, 1, dr.ceil(wish / parts))
    t = cell.t * parts * parts
    part = dr.minimum(dr.floor(t), parts * parts - 1)
    within = cell.corners.within(cell_corners(mi.UInt32(part), parts))
    grid = _Grid.of(surface, rows, within, view, mi.UInt32(k), active & ~whole)
    t = (t - part) * mi.Float(dr.select(whole, 1, grid.number))
    chosen = dr.minimum(mi.UInt32(t), dr.maximum(grid.number, 1) - 1)
    triangle = dr.select(whole, 0, grid.triangle(chosen))
    corners = within.within(cell_corners(triangle, k))
    h, s = heights(corners), t - mi.Float(dr.select(whole, 0, chosen))
    up = [value > 0 for value in h]
    lone = LoneCorner.of(up)
    a, e = (lone.at(s, mi.Float(r)) for r in (0, 1))
    start = corners.at(a)
    ends = tuple(h[0] + b.x * (h[1] - h[0]) + b.y * (h[2] - h[0]) for b in (a, e))
    share = dr.select(whole, 1, dr.square(k) / mi.Float(dr.maximum(grid.number, 1)))
    density = cell.pmf * dr.square(cell.per_side) * share
    exists = active & _differ(up) & (whole | (grid.number > 0))
    return Way(start, mi.Vector2f(corners.at(e) - start), ends, exists, density)


def _differ(up: list[mi.Bool]) -> mi.Bool:
    return (up[0] != up[1]) | (up[0] != up[2])


@dataclass
class _Grid:
    """A triangle cut into k² others, by number as of `cell_corners`."""

    k: mi.UInt32
    up: mi.UInt64  # bit i (i + 1)/2 + j: is h > 0 at the corner b = (i − j, j)/k?
    number: mi.UInt32  # of triangles at whose corners it has different signs

    @staticmethod
    def of(
        surface: BentSurface, rows: BentRows, corners: Corners, view: mi.Vector4f, k: mi.UInt32, active: mi.Bool
    ) -> _Grid:
        points = (k + 1) * (k + 2) // 2

        def look(number: mi.UInt32, i: mi.UInt32, j: mi.UInt32, up: mi.UInt64) -> tuple:
            b = corners.at(mi.Point2f(mi.Float(i - j), mi.Float(j)) / mi.Float(k))
            above = surface.height(rows, surface.bent(rows, b, active), view) > 0
            up |= dr.select(above, mi.UInt64(1) << mi.UInt64(number), 0)
            last = i == j
            return number + 1, dr.select(last, i + 1, i), dr.select(last, 0, j + 1), up

        width = dr.width(corners.b0, k)
        state = (*(dr.zeros(mi.UInt32, width) for _ in range(3)), dr.zeros(mi.UInt64, width))
        goes_on = lambda number, *_: active & (number < points)  # noqa: E731
        up = dr.while_loop(state, goes_on, look, label="where bent normals turn away")[3]
        grid = _Grid(k, up, mi.UInt32(0))
        grid.number = grid._crossed(mi.UInt32(0xFFFFFFFF), active)[1]
        return grid

    def triangle(self, which: mi.UInt32) -> mi.UInt32:
        """Of those with different signs, the one so many places after the first."""
        return self._crossed(which, mi.Bool(True))[0] - 1

    def _crossed(self, which: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Triangles are looked at up to this one of those with different signs: how many, and how many of those."""

        def goes_on(number: mi.UInt32, found: mi.UInt32) -> mi.Bool:
            return active & (number < self.k * self.k) & (found <= which)

        def look(number: mi.UInt32, found: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
            return number + 1, found + dr.select(self._differs(number), mi.UInt32(1), 0)

        width = dr.width(self.k, self.up, which)
        state = dr.zeros(mi.UInt32, width), dr.zeros(mi.UInt32, width)
        return dr.while_loop(state, goes_on, look, label="triangles with a curve")

    def _differs(self, number: mi.UInt32) -> mi.Bool:
        corners = cell_corners(number, mi.Float(1))
        return _differ([self._is_up(b) for b in (corners.b0, corners.b1, corners.b2)])

    def _is_up(self, b: mi.Point2f) -> mi.Bool:
        i, j = mi.UInt32(b.x + b.y + 0.5), mi.UInt32(b.y + 0.5)
        return (self.up >> mi.UInt64(i * (i + 1) // 2 + j)) & 1 != 0
