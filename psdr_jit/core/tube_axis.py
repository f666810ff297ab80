"""One place of a tube about a uniform cubic B-spline: its axis, its circle, its normal, where a viewer sees it edge-on.

The surface is the union of circles about c(v), of radius r(v) and perpendicular to c'(v). Where ρ = x − c leads from
the axis to the surface, its outward normal is

    n ∝ B ρ − r r' c',        B = |c'|² − ρ·c''                            [do Carmo 1976, §2-4, for tubes]

and seen from the homogeneous viewpoint (e, w), with q = e − w c, it is tangent to the line of sight where
B (ρ·q − w r²) = r r' c'·q: at two points of every circle, found by a fixed-point iteration on the small terms, which
vanish on straight and even tubes. Derivatives are by the parameter v ∈ [0, 1] of a segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Steps of the fixed-point iteration: each gains a factor of about r |c''| / |c'|².
ITERATIONS = 5


@dataclass
class Axis:
    """One place v of a segment; attached if its control points or v are."""

    c: mi.Vector3f  # [m]
    dc: mi.Vector3f
    ddc: mi.Vector3f
    r: mi.Float  # [m]
    dr: mi.Float

    @staticmethod
    def of(p: list[mi.Vector4f], v: mi.Float) -> Axis:
        """At v of the segment with the four control points p = (x, y, z, radius)."""
        rest, v2 = 1 - v, v * v
        value = [rest * rest * rest, 3 * v2 * v - 6 * v2 + 4, -3 * v2 * v + 3 * v2 + 3 * v + 1, v2 * v]
        slope = [-rest * rest, 3 * v2 - 4 * v, -3 * v2 + 2 * v + 1, v2]
        second = [rest, 3 * v - 2, 1 - 3 * v, v]
        c, dc, ddc = _blend(p, value, 1 / 6), _blend(p, slope, 1 / 2), _blend(p, second, 1)
        return Axis(*(mi.Vector3f(a.x, a.y, a.z) for a in (c, dc, ddc)), c.w, dc.w)

    def bend(self, ρ: mi.Vector3f) -> mi.Float:
        """B of the module [m²]: negative where circles run into each other."""
        return dr.squared_norm(self.dc) - dr.dot(ρ, self.ddc)

    def normal(self, ρ: mi.Vector3f) -> mi.Vector3f:
        """Outward, not of unit length."""
        return self.bend(ρ) * ρ - self.r * self.dr * self.dc

    def turned_normal(self, a: mi.Vector3f, b: mi.Vector3f) -> mi.Vector3f:
        """Direction in which the normal at r a turns as one goes round the circle towards b."""
        return self.bend(self.r * a) * b - self.r * dr.dot(b, self.ddc) * a

    def circle(self, towards: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        """Unit vectors (a, b) of the circle's plane, a as near to `towards` as can be, and how much of that lies in it.

        (a, b, c'/|c'|) is right-handed. Attached, a keeps its place on the circle while the circle tilts.
        """
        t = dr.normalize(self.dc)
        flat = towards - t * dr.dot(t, towards)
        length = dr.norm(flat)
        a = dr.select(length > 0, flat / length, mi.coordinate_system(t)[0])
        return a, dr.cross(t, a), length

    def tangent_point(self, view: mi.Vector4f, side: mi.Float) -> tuple[mi.Vector3f, mi.Bool]:
        """`(ρ, whether it exists)`: where the circle touches the line of sight, on `side` (±1) of it. Detached."""
        q = mi.Vector3f(view.x, view.y, view.z) - view.w * self.c
        a, b, length = self.circle(q)
        along = dr.dot(self.dc, q)
        bend = dr.squared_norm(self.dc)
        ρ, cos = mi.Vector3f(0), mi.Float(0)
        for _ in range(ITERATIONS):
            cos = (view.w * self.r + self.dr * along / bend) / length
            ρ = self.r * (dr.clip(cos, -1, 1) * a + side * dr.safe_sqrt(1 - dr.square(cos)) * b)
            bend = self.bend(ρ)
        return ρ, (dr.abs(cos) < 1) & (bend > 0) & (self.r > 0)


def _blend(p: list[mi.Vector4f], weights: list[mi.Float], scale: float) -> mi.Vector4f:
    return sum((a * b for a, b in zip(p[1:], weights[1:], strict=True)), p[0] * weights[0]) * scale
