"""Curves within smooth-shaded faces, on which what a point sends along the direction of view steps.

Where h = n(x)·ω = 0, with ω the direction of view and n some vector that follows from the normals at the corners: the
interpolated normal itself (`kind_shading`), or what a mirror makes of the face's own (`kind_mirror_horizon`). With ∇h
the gradient within the face for a fixed ω, and m = ∇h/|∇h|

    the curve of parallel lines of direction ω has tangent τ = n_g × m,
    it moves with the material, and by −ḣ/|∇h| along m (ḣ: of the material point, ω fixed),
    and by −n·ω̇/|∇h| along m where ω turns: seen across ω, κ = −n (m·n_perp)/|∇h|.

The lines that see a step, measured by edge length × solid angle across ω, are found by integrating δ(h) |∇h| over the
face and over directions, with |τ×ω| |m·n_perp| = |n_g·ω|: x is uniform on the face, and ω on the great circle
perpendicular to n, by its angle φ,

    ∫dω ∫dl = ∫dA ∫dφ |∇h|/|n|.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, towards_viewer, viewpoint
from .film_cover import LENS_CENTRE, curve_cover
from .kind import EdgeKind, Line, OnEdge, Side, Sight, Views
from .lights import LightBounds
from .location import EdgeLocation
from .points import clearance, facing
from .shading_curve import Face
from .smooth_faces import FaceRows, SmoothFaces

#: Barycentric step to the side at which the radiance of the face is taken.
STEP_ASIDE = 1e-3

#: By how much normals turn over a face, at most, if that is but their rounding [rad].
FLAT = 1e-6

#: Where it would lead across the face's other curve, the share of the way there.
SHORT_OF_IT = 0.5


@dataclass(frozen=True)
class CurvesWithinFaces(EdgeKind):
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

    @abstractmethod
    def of_corners(self, p: list[mi.Point3f], n: list[mi.Normal3f]) -> Face:
        """The face with the vector n of h = n·ω, of these corners."""

    @staticmethod
    def seen(rows: FaceRows, face: Face, ω: mi.Vector3f) -> mi.Bool:
        """Not edge-on, as edges of meshes have it, and a closed surface from outside."""
        towards = facing(dr.normalize(face.n_g), -ω)
        return (towards != 0) & (towards * rows.shell >= 0)

    @abstractmethod
    def other_curve(self, face: Face) -> Face:
        """A face of ours with the vector n of the other kind of curve within faces."""

    def all_faces(self) -> Face:
        """By row."""
        return self.of_corners(*self.faces.corners(self.faces.rows.corner, mi.Bool(True)))

    def face(self, row: mi.UInt32, active: mi.Bool) -> tuple[FaceRows, Face]:
        rows = dr.gather(FaceRows, self.faces.rows, row, active)
        return rows, self.of_corners(*self.faces.corners(rows.corner, active))

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """Length of the curve on the film; where only a part of it, or of the lens, sees one, that of the face."""
        rows, face = self.faces.rows, self.all_faces()
        eye = viewpoint(frame, mi.Point2f(LENS_CENTRE))
        slack = frame.aperture if frame.kind == "thinlens" else mi.Float(0)
        ends = [face.curve(mi.Float(s), eye) for s in (0.0, 1.0)]
        found = ends[0].valid & ends[1].valid
        length = curve_cover(frame, border, face.p, tuple(face.at(end.b) for end in ends), found)
        front = rows.shell * dr.dot(face.n_g, towards_viewer(eye, face.p[0]))
        hidden = (rows.shell != 0) & (front <= -slack * dr.norm(face.n_g))
        return dr.select(face.may_cross(eye, slack) & ~hidden, length, 0)

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def bends(self, face: Face) -> mi.Float:
        """By face: its area × mean |∇h| of the interpolated normal × the angle of the great circle, halved as an edge's
        azimuths are (4π sr count as 2π). 0 where normals turn by rounding alone.
        """
        bend = face.gradient_norm * dr.sqrt(0.5) / dr.norm(face.n[0] + face.n[1] + face.n[2]) * 3
        weight = face.area * bend * dr.select(self.faces.rows.shell != 0, 0.5, 1) * dr.pi
        return dr.select(dr.isfinite(weight) & (bend * dr.sqrt(face.area) > FLAT), weight, 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, face = self.face(row, active)
        curve = face.curve(t, view)
        seen = self.seen(rows, face, curve.ω)
        return self.point(face, curve.b, curve.ω, curve.weight, active & curve.valid & seen)

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        rows, face = self.face(row, active)
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
        on = self.point(face, b, ω, face.area / length, active & (length > 0))
        pdf = dr.rcp(range_φ)
        return Line(on, ω, pdf, dr.select(rows.shell != 0, 0, pdf))

    def point(self, face: Face, b: mi.Point2f, ω: mi.Vector3f, weight: mi.Float, valid: mi.Bool) -> OnEdge:
        """A point of the curve of direction ω; `weight`: of the curve, per unit of its parameter and of |∇h|."""
        x = face.at(b)
        offset, lead = clearance(x, face.size, self.centre)
        nothing = mi.Float(0)
        return OnEdge(
            x=x,
            dx=dr.cross(dr.normalize(face.n_g), face.gradient(ω, b)) * weight,
            outward=mi.Vector3f(0),
            local=mi.Point3f(b.x, b.y, 0),
            scale=nothing,
            offset=offset,
            lead=lead,
            aside=nothing,
            valid=valid & dr.isfinite(weight),
        )

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The face itself, a step away from the curve; seen edge-on, it has its other curve next to it."""
        rows, face = self.face(row, active)
        b = mi.Point2f(sight.at.local.x, sight.at.local.y)
        m = face.gradient(sight.ω, b)
        towards = dr.select(which == 0, -1.0, 1.0) * dr.sign(dr.dot(m, sight.n_perp))
        step = face.barycentric(m)
        step *= STEP_ASIDE * towards / dr.maximum(dr.abs(step.x), dr.abs(step.y))
        other = self.other_curve(face)
        h, h_there = dr.dot(other.normal(b), sight.ω), dr.dot(other.normal(b + step), sight.ω)
        step *= dr.select((h > 0) != (h_there > 0), SHORT_OF_IT * h / (h - h_there), 1)
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(pi.valid, sight.r, dr.inf)
        pi.prim_index = rows.prim
        pi.shape = dr.gather(mi.ShapePtr, self.faces.shapes, rows.shape, active)
        pi.prim_uv = b + step
        return Side(mi.Ray3f(sight.viewer, sight.ω), pi, mi.Bool(False), own=mi.Bool(False), differs=mi.Bool(True))

    def lies_in(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Normal3f:
        return mi.Normal3f(dr.normalize(self.face(row, active)[1].n_g))

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Material velocity, and −ḣ/|∇h| along m."""
        rows, face = self.face(row, active)
        moved = self.of_corners(*self.faces.attached_corners(rows.corner, active))
        b = mi.Point2f(dr.detach(at.local.x), dr.detach(at.local.y))
        m = dr.detach(face.gradient(ω, b))
        h = dr.dot(moved.normal(b), dr.detach(ω))
        x = moved.at(b)
        per_h = dr.select(active & (dr.squared_norm(m) > 0), m * dr.rcp(dr.squared_norm(m)), 0)
        return mi.Vector3f(x - dr.detach(x)) - per_h * (h - dr.detach(h))

    def turn(
        self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f, active: mi.Bool
    ) -> mi.Vector3f:
        _, face = self.face(row, active)
        b = mi.Point2f(at.local.x, at.local.y)
        m, n = face.gradient(ω, b), face.normal(b)
        slope2 = dr.squared_norm(m)
        return mi.Vector3f(-n * dr.select(slope2 > 0, dr.dot(m, n_perp) / slope2, 0))
