"""Shading outlines: curves inside smooth-shaded faces, on which the interpolated normal turns away from the viewer.

A BSDF and an area light are evaluated in the shading frame: what a point x sends along −ω steps where h = n(x)·ω = 0,
ω the direction of view and n the interpolated normal. Position and normal are linear on a face, so that the gradient
∇h within the face is constant for a fixed ω, and with m = ∇h/|∇h|

    the curve of parallel lines of direction ω has tangent τ = n_g × m,
    it moves with the material, and by −ḣ/|∇h| along m (ḣ: of the material point, ω fixed),
    and by −n·ω̇/|∇h| along m where ω turns: seen across ω, κ = −n (m·n_perp)/|∇h|.

The lines that see a step, measured by edge length × solid angle across ω, are found in two ways, both by integrating
δ(h) |∇h| over the face and over directions, with |τ×ω| |m·n_perp| = |n_g·ω|.

*From a viewpoint* o (the sensor): the curve h(x, (x − o)/|x − o|) = 0 separates one corner A, or none, from the others.
With E(s) on the side opposite to A, and x = A + r (E − A), h |x − o| is quadratic in r; one root lies between corners
of different sign. Per unit of s the curve weighs |∇h| |∂x/∂s × ∂x/∂r| / |∂h/∂r|, where h is taken as seen from o.

*From anywhere*: x uniform on the face, and ω on the great circle perpendicular to n, by its angle φ:
∫dω ∫dl = ∫dA ∫dφ |∇h|/|n|.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, viewpoint
from .film_cover import LENS_CENTRE, curve_cover
from .kind import EdgeKind, Line, OnEdge, Side, Sight, Use, Views
from .lights import LightBounds
from .location import EdgeLocation
from .points import VISIBILITY_EPSILON, clearance
from .shading_curve import Face, curve_on, may_cross
from .smooth_faces import FaceRows, SmoothFaces

#: Barycentric step to the side at which the radiance of the face is taken.
STEP_ASIDE = 1e-3


@dataclass(frozen=True)
class ShadingOutlines(EdgeKind):
    """One row per face; most of them are crossed by no curve."""

    blocks_light: ClassVar[bool] = False
    shades_only: ClassVar[bool] = True

    faces: SmoothFaces
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.faces.rows.prim)

    def moving(self) -> mi.Bool:
        return self.faces.rows.moves

    def places(self) -> mi.Point3f:
        p, _ = self.faces.corners(self.faces.rows.corner, mi.Bool(True))
        return (p[0] + p[1] + p[2]) / 3

    def _face(self, row: mi.UInt32, active: mi.Bool) -> tuple[FaceRows, Face]:
        rows = dr.gather(FaceRows, self.faces.rows, row, active)
        return rows, Face(*self.faces.corners(rows.corner, active))

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """Length of the curve on the film; where a lens may see one that its centre does not, that of the face."""
        rows = self.faces.rows
        face = Face(*self.faces.corners(rows.corner, mi.Bool(True)))
        eye = viewpoint(frame, mi.Point2f(LENS_CENTRE))
        slack = frame.aperture if frame.kind == "thinlens" else mi.Float(0)
        ends = [curve_on(face, mi.Float(s), eye) for s in (0.0, 1.0)]
        found = ends[0].valid & ends[1].valid
        length = curve_cover(frame, border, face.p, tuple(face.at(end.b) for end in ends), found)
        front = rows.shell * dr.dot(face.n_g, mi.Vector3f(eye.x, eye.y, eye.z) - eye.w * mi.Vector3f(face.p[0]))
        hidden = (rows.shell != 0) & (front <= -slack * dr.norm(face.n_g))
        return dr.select(may_cross(face, eye, slack) & ~hidden, length, 0)

    def line_weights(self, use: Use) -> mi.Float:
        """Area × mean |∇h| × the angle of the great circle, halved as an edge's azimuths are (4π sr count as 2π)."""
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        rows = self.faces.rows
        face = Face(*self.faces.corners(rows.corner, mi.Bool(True)))
        bend = face.gradient_norm * dr.sqrt(0.5) / dr.norm(face.n[0] + face.n[1] + face.n[2]) * 3
        weight = face.area * bend * dr.select(rows.shell != 0, 0.5, 1) * dr.pi
        return dr.select(dr.isfinite(weight), weight, 0)

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, face = self._face(row, active)
        curve = curve_on(face, t, view)
        seen = dr.dot(face.n_g, curve.ω) * rows.shell <= 0  # a closed surface is seen from outside
        return self._point(face, curve.b, curve.ω, curve.weight, active & curve.valid & seen)

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        rows, face = self._face(row, active)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(t, u.x))
        n = face.normal(b)
        length = dr.norm(n)
        n_s = n / length
        # On the great circle, `inwards` leads into the surface: seen from in front are directions up to 90° from it.
        into = -dr.normalize(face.n_g) * dr.select(rows.shell < 0, -1.0, 1.0)
        inwards = into - n_s * dr.dot(n_s, into)
        size = dr.norm(inwards)
        any_s, _ = mi.coordinate_system(n_s)
        inwards = dr.select(size > 0, inwards / size, any_s)
        range_φ = dr.select(rows.shell != 0, dr.pi, dr.two_pi)
        sin, cos = dr.sincos((u.y - 0.5) * range_φ)
        ω = mi.Vector3f(cos * inwards + sin * dr.cross(n_s, inwards))
        on = self._point(face, b, ω, face.area / length, active & (length > 0))
        pdf = dr.rcp(range_φ)
        return Line(on, ω, pdf, dr.select(rows.shell != 0, 0, pdf))

    def _point(self, face: Face, b: mi.Point2f, ω: mi.Vector3f, weight: mi.Float, valid: mi.Bool) -> OnEdge:
        """A point of the curve of direction ω; `weight`: of the curve, per unit of its parameter and of |∇h|."""
        x = face.at(b)
        offset, lead = clearance(x, face.size, self.centre)
        nothing = mi.Float(0)
        return OnEdge(
            x=x,
            dx=dr.cross(dr.normalize(face.n_g), face.gradient(ω)) * weight,
            outward=mi.Vector3f(0),
            local=mi.Point3f(b.x, b.y, 0),
            scale=nothing,
            offset=offset,
            lead=lead,
            aside=nothing,
            valid=valid & dr.isfinite(weight),
        )

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The face itself, a step away from the curve."""
        rows, face = self._face(row, active)
        m = face.gradient(sight.ω)
        towards = dr.select(which == 0, -1.0, 1.0) * dr.sign(dr.dot(m, sight.n_perp))
        step = face.barycentric(m)
        step *= STEP_ASIDE * towards / dr.maximum(dr.abs(step.x), dr.abs(step.y))
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(pi.valid, sight.r, dr.inf)
        pi.prim_index = rows.prim
        pi.shape = dr.gather(mi.ShapePtr, self.faces.shapes, rows.shape, active)
        pi.prim_uv = mi.Point2f(sight.at.local.x, sight.at.local.y) + step
        return Side(mi.Ray3f(sight.viewer, sight.ω), pi, mi.Bool(False), own=mi.Bool(False), differs=mi.Bool(True))

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Just above a face that is seen all but edge-on: what a line of sight along it meets is rounding."""
        n = dr.normalize(self._face(row, active)[1].n_g)
        towards = -dr.dot(n, sight.ω)
        above = dr.select(dr.abs(towards) < VISIBILITY_EPSILON, dr.sign(towards) * sight.offset, 0)
        return sight.at.x + above * n

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Material velocity, and −ḣ/|∇h| along m."""
        rows, face = self._face(row, active)
        moved = Face(*self.faces.attached_corners(rows.corner, active))
        b = mi.Point2f(dr.detach(at.local.x), dr.detach(at.local.y))
        m = dr.detach(face.gradient(ω))
        h = dr.dot(moved.normal(b), dr.detach(ω))
        x = moved.at(b)
        per_h = dr.select(active & (dr.squared_norm(m) > 0), m * dr.rcp(dr.squared_norm(m)), 0)
        return mi.Vector3f(x - dr.detach(x)) - per_h * (h - dr.detach(h))

    def turn(
        self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f, active: mi.Bool
    ) -> mi.Vector3f:
        _, face = self._face(row, active)
        m = face.gradient(ω)
        n = face.normal(mi.Point2f(at.local.x, at.local.y))
        slope2 = dr.squared_norm(m)
        return mi.Vector3f(-n * dr.select(slope2 > 0, dr.dot(m, n_perp) / slope2, 0))
