"""Ways across patches on which the curves are met where bent normals turn from a viewpoint.

The triangle of a patch in b is cut into k² alike, of which t picks one: k = 1 where the patch is no larger than a texel
and h = n·(o − x)/|o − x| has one sign at two of its corners and another at the third. With A the corner of a small
triangle that is alone on its side, the way is r (E(s) − A) from there to a point of the opposite side, and it has one
root. Ways meet a curve, per area of b and change of h, with the density

    D = |∇_b h·(E − A)| / r,

as |∂b/∂s × ∂b/∂r| = r/k², and t picks one of k². Triangles with one sign at all corners are taken to have no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .bent_rows import BentRows
from .bent_surface import BentSurface
from .shading_curve import LoneCorner

#: Size of patches, in texels, that need not be cut where the signs at their corners differ.
SMALL = 0.5

#: Triangles along the side of others: per texel, and at least.
CUTS, LEAST_CUTS = 4.0, 4.0

#: Least slope that counts, relative to the mean one: a curve that touches a way for once is given up to this.
FLATTEST = 0.1

#: Corners of a patch.
CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


@dataclass
class Way:
    """From a corner to the opposite side of a triangle, in b."""

    start: mi.Point2f
    along: mi.Vector2f
    h: tuple[mi.Float, mi.Float]  # cosine between the bent normal and the direction to the viewer at both ends, about
    exists: mi.Bool

    def met(self, r: mi.Float, slope: mi.Vector2f) -> mi.Float:
        """Density D of ways at the share r of this one, per change of h; `slope`: ∂h/∂b."""
        least = FLATTEST * dr.abs(self.h[1] - self.h[0])
        return dr.maximum(dr.abs(dr.dot(slope, self.along)), least) / r


def way_across(surface: BentSurface, rows: BentRows, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> Way:
    """On which the curve is looked for; t ∈ [0, 1) picks it."""

    def heights(places: list[mi.Point2f]) -> list[mi.Float]:
        return [surface.height(rows, bent, view) for bent in surface.bent_at(rows, places, active)]

    whole = _differ(heights([mi.Point2f(*corner) for corner in CORNERS])) & (rows.texels <= SMALL)
    k = dr.select(whole, mi.Float(1), dr.maximum(dr.ceil(CUTS * rows.texels), LEAST_CUTS))
    number = dr.minimum(dr.floor(t * k * k), k * k - 1)
    corners = [mi.Point2f(corner) / k for corner in _small_triangle(number)]
    h, s = heights(corners), t * k * k - number
    lone = LoneCorner.of([value > 0 for value in h])

    def at(b: mi.Point2f, values: list):
        return values[0] + b.x * (values[1] - values[0]) + b.y * (values[2] - values[0])

    a, e = (lone.at(s, mi.Float(r)) for r in (0, 1))
    start = mi.Point2f(at(a, corners))
    return Way(start, mi.Vector2f(at(e, corners) - start), (at(a, h), at(e, h)), active & _differ(h))


def _differ(h: list[mi.Float]) -> mi.Bool:
    """Is one of these on the other side than another?"""
    up = [value > 0 for value in h]
    return (up[0] != up[1]) | (up[0] != up[2])


def _small_triangle(number: mi.Float) -> tuple[mi.Vector2f, mi.Vector2f, mi.Vector2f]:
    """Corners of a triangle, in units of its side: those with b1 + b2 between i and i + 1 are numbered i², i² + 1, …"""
    i = dr.floor(dr.sqrt(number + 0.5))  # half a number off, where rounding is no matter
    place = number - i * i
    m = dr.floor(place / 2)
    upright = place == 2 * m
    apex, right = mi.Vector2f(i - m, m), mi.Vector2f(i - m, m + 1)
    return apex, dr.select(upright, mi.Vector2f(i + 1 - m, m), mi.Vector2f(i - m - 1, m + 1)), right
