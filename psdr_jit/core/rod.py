"""One segment of a linear curve: the spheres about c(v) = c₀ + v Δc of radius r(v) = r₀ + v Δr, v ∈ [0, 1], and all
that is inside of one of them.

With the unit vector u along Δc and s = Δr / |Δc|, the surface between the end spheres is a cone, on which

    (x − c(v))·u = −s r(v),        n = (x − c(v)) / r(v),        n·u = −s

so that v is linear in x, and n the same all along a straight line. Seen from the homogeneous viewpoint (e, w) the
outline is where n·(e − w c) = w r: two of these lines, and arcs of circles on the spheres at the ends.
Mitsuba shows the outer side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Rod:
    """Attached if its control points are. One entry per sample."""

    c: mi.Vector3f  # c₀ [m]
    dc: mi.Vector3f  # Δc
    r: mi.Float  # r₀ [m]
    dr: mi.Float  # Δr

    @staticmethod
    def between(a: mi.Vector4f, b: mi.Vector4f) -> Rod:
        """From control point `a` = (x, y, z, radius) to `b`."""
        return Rod(mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(b.x - a.x, b.y - a.y, b.z - a.z), a.w, b.w - a.w)

    def centre(self, v: mi.Float) -> mi.Vector3f:
        return self.c + v * self.dc

    def radius(self, v: mi.Float) -> mi.Float:
        return self.r + v * self.dr

    @property
    def axis(self) -> tuple[mi.Vector3f, mi.Float]:
        """`(u, s)`."""
        scale = dr.rsqrt(dr.squared_norm(self.dc))
        return self.dc * scale, self.dr * scale

    @property
    def has_side(self) -> mi.Bool:
        """Is there a cone at all? Not if one end sphere lies inside the other."""
        return dr.abs(self.dr) < dr.norm(self.dc)

    def foot(self, x: mi.Point3f) -> mi.Float:
        """v of the sphere on which `x`, a point of the surface or near it, lies: not clipped, beyond [0, 1] on the ends
        of the segment.
        """
        room = dr.squared_norm(self.dc) - dr.square(self.dr)
        v = (dr.dot(x - self.c, self.dc) + self.r * self.dr) / room
        return dr.select(room > 0, v, dr.select(self.dr > 0, 1, 0))

    def place(self, x: mi.Point3f) -> tuple[mi.Float, mi.Vector3f]:
        """`(v, n)` at a point of the surface, v clipped; n is the outward unit normal."""
        v = dr.clip(self.foot(x), 0, 1)
        return v, dr.normalize(x - self.centre(v))

    def height(self, x: mi.Point3f) -> mi.Float:
        """Distance from the surface [m], negative inside."""
        v = dr.clip(self.foot(x), 0, 1)
        return dr.norm(x - self.centre(v)) - self.radius(v)

    def side_normal(self, view: mi.Vector4f, side: mi.Float) -> tuple[mi.Vector3f, mi.Bool]:
        """`(n, whether it exists)`: the normal along the outline on `side` (±1) of the cone."""
        u, s = self.axis
        q = mi.Vector3f(view.x, view.y, view.z) - view.w * self.c
        flat = q - u * dr.dot(u, q)
        length, k = dr.norm(flat), dr.safe_sqrt(1 - dr.square(s))
        cos = (view.w * self.r + s * dr.dot(u, q)) / (k * length)
        a = dr.select(length > 0, flat / length, mi.coordinate_system(u)[0])
        sin = side * dr.safe_sqrt(1 - dr.square(cos))
        n = k * (dr.clip(cos, -1, 1) * a + sin * dr.cross(u, a)) - s * u
        return n, self.has_side & (dr.abs(cos) < 1)

    def end_normal(self, view: mi.Vector4f, end: mi.Float, turns: mi.Float):
        """`(n, dn/dturns, whether it exists)`: along the outline of the sphere at v = `end`, at `turns` about it."""
        q = mi.Vector3f(view.x, view.y, view.z) - view.w * self.centre(end)
        length = dr.norm(q)
        towards = q / length
        cos = view.w * self.radius(end) / length
        radius = dr.safe_sqrt(1 - dr.square(cos))
        # counted from the axis, so that pieces keep their place on the sphere while the viewpoint moves
        u, _ = self.axis
        flat = u - towards * dr.dot(u, towards)
        a = dr.select(dr.squared_norm(flat) > 0, dr.normalize(flat), mi.coordinate_system(towards)[0])
        b = dr.cross(towards, a)
        sin_φ, cos_φ = dr.sincos(dr.two_pi * turns)
        n = cos * towards + radius * (cos_φ * a + sin_φ * b)
        return n, dr.two_pi * radius * (cos_φ * b - sin_φ * a), (cos < 1) & (self.radius(end) > 0)
