"""On an octant of a grid of signed distances: where does the blended normal turn away from a viewpoint?

The geometry behind `kind_grid_shading`, in coordinates of the octant (`core.sdf_octant`). At a fixed Z the surface is
Y(X) = −(a₀ + a₁X) / (a₂ + a₃X). Where |∂f/∂X| ≤ |∂f/∂Y|, with the sign σ of ∂f/∂Y, and within the octant,

    σ(a₂ + a₃X) ≥ √|a₁a₂ − a₀a₃|,     −σ(a₀ + a₁X) ≥ 0,     σ(a₀ + a₁X + (a₂ + a₃X)/2) ≥ 0,

of which each holds on one side of some X. There G = n·(e − w p), seen from the homogeneous viewpoint (e, w), is looked
at: it changes sign at most once, as octants are small. Detached, branch-free.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sdf_cell import Cell
from ..core.sdf_octant import REACH, Octant

#: Most steps of Newton's method, kept between two points of different sign, and a change of X that ends it.
STEPS, CLOSE = 16, 1e-7

#: By how much normals inside an octant may leave the range of those at its corners, as a share of the range.
BEYOND_CORNERS = 0.5


@dataclass
class Patch:
    """A row of an octant: what X is the parameter of at a fixed Z. One entry per sample."""

    octant: Octant
    cell: Cell
    rises: mi.Float  # σ = ±1

    @staticmethod
    def of(octant: Octant, rises: mi.Float) -> Patch:
        return Patch(octant, octant.cell, rises)

    def span(self, z: mi.Float) -> Span:
        f = [dr.lerp(low, high, z) for low, high in zip(self.cell.low, self.cell.high, strict=True)]
        a = [f[0], f[1] - f[0], f[2] - f[0], f[3] - f[2] - f[1] + f[0]]
        σ = self.rises
        steep = dr.sqrt(dr.abs(a[1] * a[2] - a[0] * a[3]))
        start, end = mi.Float(0), mi.Float(REACH)
        for constant, slope in (
            (σ * a[2] - steep, σ * a[3]),
            (-σ * a[0], -σ * a[1]),
            (σ * (a[0] + REACH * a[2]), σ * (a[1] + REACH * a[3])),
        ):
            zero = -constant / slope
            start = dr.select(slope > 0, dr.maximum(start, zero), start)
            end = dr.select(slope < 0, dr.minimum(end, zero), end)
            end = dr.select((slope == 0) & (constant < 0), -1, end)
        return Span(a, z, start, end)

    def height(self, p: mi.Vector3f, view: mi.Vector4f) -> mi.Float:
        """G: > 0 where the blended normal faces the viewer, < 0 where it is turned away, or the reverse."""
        return dr.dot(self.octant.blended(p), mi.Vector3f(view.x, view.y, view.z) - view.w * p)

    def turns_away(self, z: mi.Float, view: mi.Vector4f) -> tuple[mi.Vector3f, mi.Bool]:
        """`(p, whether it exists)`: the curve at Z = `z`."""
        span = self.span(z)
        first, last = self.height(span.at(span.start), view), self.height(span.at(span.end), view)
        exists = (span.start < span.end) & ((first > 0) != (last > 0))
        x = span.start + (span.end - span.start) * dr.select(exists, first / (first - last), 0)

        def goes_on(x: mi.Float, low: mi.Float, high: mi.Float, change: mi.Float, k: mi.UInt32):
            return exists & (k < STEPS) & (change > CLOSE)

        def step(x: mi.Float, low: mi.Float, high: mi.Float, change: mi.Float, k: mi.UInt32):
            p = span.at(x)
            q = mi.Vector3f(view.x, view.y, view.z) - view.w * p
            n, g = self.octant.ascent(p, q)
            along = span.along(x)
            value, slope = dr.dot(n, q), dr.dot(g - view.w * n, along)
            before = (value > 0) == (first > 0)
            low, high = dr.select(before, x, low), dr.select(before, high, x)
            next_x = x - value / slope
            next_x = dr.select((next_x > low) & (next_x < high), next_x, (low + high) / 2)
            return next_x, low, high, dr.abs(next_x - x), k + 1

        state = (x, mi.Float(span.start), mi.Float(span.end), mi.Float(REACH), mi.UInt32(0))
        x = dr.while_loop(state, goes_on, step, label="blended normals turn away")[0]
        return span.at(dr.select(exists, x, span.start)), exists

    def may_turn(self, view: mi.Vector4f) -> mi.Bool:
        """False where G has one sign all over the octant: by the ranges of normals and of directions to the viewer."""
        corners = [mi.Vector3f(*(REACH * (k >> a & 1) for a in range(3))) for k in range(8)]
        n = [self.octant.blended(p) for p in corners]
        q = [mi.Vector3f(view.x, view.y, view.z) - view.w * p for p in (corners[0], corners[7])]
        least, most = mi.Float(0), mi.Float(0)
        for a in range(3):
            low, high = n[0][a], n[0][a]
            for other in n[1:]:
                low, high = dr.minimum(low, other[a]), dr.maximum(high, other[a])
            slack = BEYOND_CORNERS * (high - low)
            products = [u * v[a] for u in (low - slack, high + slack) for v in q]
            least += dr.minimum(dr.minimum(products[0], products[1]), dr.minimum(products[2], products[3]))
            most += dr.maximum(dr.maximum(products[0], products[1]), dr.maximum(products[2], products[3]))
        return (least <= 0) & (most >= 0)


@dataclass
class Span:
    """The surface of a patch at a fixed Z, from X = `start` to X = `end`."""

    a: list[mi.Float]
    z: mi.Float
    start: mi.Float
    end: mi.Float

    def at(self, x: mi.Float) -> mi.Vector3f:
        y = -(self.a[0] + self.a[1] * x) / (self.a[2] + self.a[3] * x)
        return mi.Vector3f(x, dr.select(dr.isfinite(y), y, 0), self.z)

    def along(self, x: mi.Float) -> mi.Vector3f:
        """dp/dX."""
        p = self.at(x)
        dy = -(self.a[1] + self.a[3] * p.y) / (self.a[2] + self.a[3] * x)
        return mi.Vector3f(1, dr.select(dr.isfinite(dy), dy, 0), 0)
