"""On a face with linearly interpolated normals: where does the normal turn away from a viewpoint?

The geometry behind `kind_shading`, where the formulas are derived. Detached, branch-free.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Where a line crosses the curve twice, this many turns of the parameter alternate between the two points.
ALTERNATIONS = 1024


@dataclass
class CurvePoint:
    """A point of the curve as seen from a viewpoint."""

    b: mi.Point2f
    ω: mi.Vector3f  # unit, from the viewpoint to it
    weight: mi.Float  # |∂x/∂s × ∂x/∂r| / |∂h/∂r| [m³]
    valid: mi.Bool


@dataclass
class LoneCorner:
    """The corner of a triangle that lies alone on its side of a curve; the first where none does."""

    second: mi.Bool
    third: mi.Bool

    @staticmethod
    def of(side: list[mi.Bool]) -> LoneCorner:
        """`side`: on which one each corner lies."""
        return LoneCorner(*((side[k] != side[k - 1]) & (side[k] != side[k - 2]) for k in (1, 2)))

    def first(self, values: list) -> list[mi.Vector3f]:
        """What belongs to the corners, the lone one first, as they follow each other."""
        after = [[values[(i + k) % 3] for k in range(3)] for i in range(3)]
        return [
            mi.Vector3f(dr.select(self.second, b, dr.select(self.third, c, a))) for a, b, c in zip(*after, strict=True)
        ]

    def at(self, s: mi.Float, r: mi.Float) -> mi.Point2f:
        """The share r of the way from it to the point s of the opposite side."""
        lone, next_, last = 1 - r, r * (1 - s), r * s
        b1 = dr.select(self.second, lone, dr.select(self.third, last, next_))
        b2 = dr.select(self.second, next_, dr.select(self.third, lone, last))
        return mi.Point2f(b1, b2)


@dataclass
class Face:
    """A triangle and the normals at its corners. Barycentric (b1, b2) as Mitsuba's `prim_uv`."""

    p: list[mi.Point3f]
    n: list[mi.Normal3f]

    def at(self, b: mi.Point2f) -> mi.Point3f:
        return mi.Point3f(self.p[0] + b.x * (self.p[1] - self.p[0]) + b.y * (self.p[2] - self.p[0]))

    def normal(self, b: mi.Point2f) -> mi.Normal3f:
        """Interpolated, not of unit length."""
        return mi.Normal3f(self.n[0] + b.x * (self.n[1] - self.n[0]) + b.y * (self.n[2] - self.n[0]))

    @property
    def sides(self) -> tuple[mi.Vector3f, mi.Vector3f]:
        return mi.Vector3f(self.p[1] - self.p[0]), mi.Vector3f(self.p[2] - self.p[0])

    @property
    def n_g(self) -> mi.Vector3f:
        """By the winding, of twice the area's length."""
        return dr.cross(*self.sides)

    @property
    def area(self) -> mi.Float:
        return dr.norm(self.n_g) / 2

    @property
    def size(self) -> mi.Float:
        e1, e2 = self.sides
        return dr.maximum(dr.norm(e1), dr.norm(e2))

    def barycentric(self, v: mi.Vector3f) -> mi.Vector2f:
        """How (b1, b2) change along a vector in the face's plane."""
        e1, e2 = self.sides
        n = self.n_g
        scale = dr.rcp(dr.squared_norm(n))
        return mi.Vector2f(dr.dot(dr.cross(e2, n), v), dr.dot(dr.cross(n, e1), v)) * scale

    def gradient(self, ω: mi.Vector3f, b: mi.Point2f) -> mi.Vector3f:
        """∇h of h = n·ω within the face [1/m], here the same at every point b."""
        return self.ascent(dr.dot(self.n[1] - self.n[0], ω), dr.dot(self.n[2] - self.n[0], ω))

    def ascent(self, rise1: mi.Float, rise2: mi.Float) -> mi.Vector3f:
        """Gradient within the face of what changes by these numbers along its sides."""
        e1, e2 = self.sides
        n = self.n_g
        return (rise1 * dr.cross(e2, n) + rise2 * dr.cross(n, e1)) * dr.rcp(dr.squared_norm(n))

    @property
    def gradient_norm(self) -> mi.Float:
        """√Σ|∇n_k|² over the components of n [1/m]."""
        e1, e2 = self.sides
        d1, d2 = mi.Vector3f(self.n[1] - self.n[0]), mi.Vector3f(self.n[2] - self.n[0])
        square = dr.squared_norm(d1) * dr.squared_norm(e2) + dr.squared_norm(d2) * dr.squared_norm(e1)
        square -= 2 * dr.dot(d1, d2) * dr.dot(e1, e2)
        return dr.safe_sqrt(square) / dr.norm(self.n_g)

    def _heights(self, view: mi.Vector4f) -> list[mi.Float]:
        """n·(o − x) at the corners, or n·(direction to the viewer): > 0 where they face it."""
        eye = mi.Vector3f(view.x, view.y, view.z)
        return [dr.dot(n, eye - view.w * p) for p, n in zip(self.p, self.n, strict=True)]

    def may_cross(self, view: mi.Vector4f, slack: mi.Float) -> mi.Bool:
        """False where no point of the face turns away from any viewpoint within `slack` of `view` [m], or all of them.

        Between corners, n·(o − x) departs from its interpolation by at most a quarter of |Δn·Δx|.
        """
        g = self._heights(view)
        reach = [slack * dr.norm(n) for n in self.n]
        bulge = mi.Float(0)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            bulge = dr.maximum(bulge, dr.abs(dr.dot(self.n[j] - self.n[i], self.p[j] - self.p[i])) / 4)
        bulge *= view.w
        low = dr.minimum(dr.minimum(g[0] - reach[0], g[1] - reach[1]), g[2] - reach[2])
        high = dr.maximum(dr.maximum(g[0] + reach[0], g[1] + reach[1]), g[2] + reach[2])
        return (low - bulge <= 0) & (high + bulge >= 0)

    def curve(self, s: mi.Float, view: mi.Vector4f) -> CurvePoint:
        """The curve on the way from the corner that lies alone on its side of it to the point s of the opposite side.

        Where no corner is alone, or that way crosses the curve twice, each of both points takes every other of many
        small intervals of s, and counts twice.
        """
        corner = LoneCorner.of([height > 0 for height in self._heights(view)])
        eye, w = mi.Vector3f(view.x, view.y, view.z), view.w
        p, n = corner.first(self.p), corner.first(self.n)
        end, n_end = p[1] + s * (p[2] - p[1]), n[1] + s * (n[2] - n[1])
        # (1 − r)² c0 + r (1 − r) c1 + r² c2
        c0, c2 = dr.dot(n[0], eye - w * p[0]), dr.dot(n_end, eye - w * end)
        c1 = dr.dot(n[0], eye - w * end) + dr.dot(n_end, eye - w * p[0])
        square, linear = c0 - c1 + c2, c1 - 2 * c0
        under_root = dr.square(linear) - 4 * square * c0
        q = -0.5 * (linear + dr.select(linear < 0, -1.0, 1.0) * dr.safe_sqrt(under_root))
        r1, r2 = q / square, c0 / q
        in1, in2 = ((r > 0) & (r < 1) for r in (r1, r2))
        turn = s * ALTERNATIONS
        odd = turn - dr.floor(turn) < 0.5
        both = in1 & in2
        take1 = in1 & (~in2 | odd)
        r = dr.select(take1, r1, r2)

        x = mi.Vector3f(p[0] + r * (end - p[0]))
        along = eye - w * x
        distance = dr.norm(along)
        slope = dr.abs(2 * square * r + linear)
        area = dr.norm(dr.cross(r * (p[2] - p[1]), end - p[0]))
        return CurvePoint(
            corner.at(s, r),
            -along / distance,
            area * distance / slope * dr.select(both, 2.0, 1.0),
            (in1 | in2) & (under_root >= 0) & (slope > 0),
        )
