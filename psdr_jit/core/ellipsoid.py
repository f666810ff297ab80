"""An ellipsoid: points c + A m of the unit sphere, |m| = 1, with A = R⁻ᵀ diag(s).

R is what Mitsuba makes of a quaternion: a rotation only if that has unit length, and it is the transpose that Mitsuba
applies to points of space. Normals are A⁻ᵀ m = R diag(1/s) m. Seen from the homogeneous viewpoint (e, w), in
coordinates of the sphere q = A⁻¹ (e − w c), the outline is where m·q = w: a circle of the sphere. Mitsuba shows the
outer side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Ellipsoid:
    """Attached if its parameters are. One entry per sample."""

    c: mi.Vector3f  # [m]
    s: mi.Vector3f  # half axes [m]
    turn: mi.Matrix3f  # R

    @staticmethod
    def of(data: list[mi.Float], extent: mi.Float) -> Ellipsoid:
        """From Mitsuba's ten numbers, centre, scales and quaternion, and the factor on the scales."""
        turn = mi.Matrix3f(dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(*data[6:])))
        return Ellipsoid(mi.Vector3f(*data[:3]), mi.Vector3f(*data[3:6]) * extent, turn)

    def vector(self, m: mi.Vector3f) -> mi.Vector3f:
        """A m."""
        return mi.Vector3f(dr.rcp(self.turn).T @ (self.s * m))

    def point(self, m: mi.Vector3f) -> mi.Point3f:
        return mi.Point3f(self.c + self.vector(m))

    def on_sphere(self, v: mi.Vector3f) -> mi.Vector3f:
        """A⁻¹ v."""
        return mi.Vector3f(self.turn.T @ v) / self.s

    def normal(self, m: mi.Vector3f) -> mi.Vector3f:
        """Outward, of unit length."""
        return dr.normalize(mi.Vector3f(self.turn @ (m / self.s)))

    @property
    def size(self) -> mi.Float:
        """Smallest half axis [m]."""
        return dr.minimum(dr.minimum(dr.abs(self.s.x), dr.abs(self.s.y)), dr.abs(self.s.z))

    def outline(self, view: mi.Vector4f, turns: mi.Float):
        """`(m, dm/dturns, whether it exists)`."""
        q = self.on_sphere(mi.Vector3f(view.x, view.y, view.z) - view.w * self.c)
        length = dr.norm(q)
        towards, cos = q / length, view.w / length
        radius = dr.safe_sqrt(1 - dr.square(cos))
        # counted from an axis of the ellipsoid, so that pieces keep their place while the viewpoint moves
        flat = mi.Vector3f(0, 0, 1) - towards * towards.z
        a = dr.select(dr.squared_norm(flat) > 0, dr.normalize(flat), mi.Vector3f(1, 0, 0))
        b = dr.cross(towards, a)
        sin_φ, cos_φ = dr.sincos(dr.two_pi * turns)
        m = cos * towards + radius * (cos_φ * a + sin_φ * b)
        return m, dr.two_pi * radius * (cos_φ * b - sin_φ * a), cos < 1
