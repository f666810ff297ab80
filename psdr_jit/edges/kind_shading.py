"""Shading outlines: curves inside smooth-shaded faces, on which the interpolated normal turns away from the viewer.

A BSDF and an area light are evaluated in the shading frame: what a point x sends along −ω steps where h = n(x)·ω = 0,
ω the direction of view and n the interpolated normal. Position and normal are linear on a face, so that the gradient
∇h within the face is constant for a fixed ω (`kind_within_faces` says how the curve moves, and how lines that see it
from anywhere are drawn).

*From a viewpoint* o (the sensor) they are found directly: the curve h(x, (x − o)/|x − o|) = 0 separates one corner A,
or none, from the others. With E(s) on the side opposite to A, and x = A + r (E − A), h |x − o| is quadratic in r; one
root lies between corners of different sign. Per unit of s the curve weighs |∇h| |∂x/∂s × ∂x/∂r| / |∂h/∂r|, where h is
taken as seen from o.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, towards_viewer, viewpoint
from .film_cover import LENS_CENTRE, curve_cover
from .kind import OnEdge, Use
from .kind_mirror_horizon import MirroredFace
from .kind_within_faces import CurvesWithinFaces
from .shading_curve import Face, curve_on, may_cross

#: By how much normals turn over a face, at most, if that is but their rounding [rad].
FLAT = 1e-6


class ShadingOutlines(CurvesWithinFaces):
    """Where n is the interpolated normal."""

    def of_corners(self, p: list[mi.Point3f], n: list[mi.Normal3f]) -> Face:
        return Face(p, n)

    def other_curve(self, face: Face) -> Face:
        return MirroredFace(face.p, face.n)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """Length of the curve on the film; where a lens may see one that its centre does not, that of the face."""
        rows, face = self.faces.rows, self.all_faces()
        eye = viewpoint(frame, mi.Point2f(LENS_CENTRE))
        slack = frame.aperture if frame.kind == "thinlens" else mi.Float(0)
        ends = [curve_on(face, mi.Float(s), eye) for s in (0.0, 1.0)]
        found = ends[0].valid & ends[1].valid
        length = curve_cover(frame, border, face.p, tuple(face.at(end.b) for end in ends), found)
        front = rows.shell * dr.dot(face.n_g, towards_viewer(eye, face.p[0]))
        hidden = (rows.shell != 0) & (front <= -slack * dr.norm(face.n_g))
        return dr.select(may_cross(face, eye, slack) & ~hidden, length, 0)

    def line_weights(self, use: Use) -> mi.Float:
        """Area × mean |∇h| × the angle of the great circle, halved as an edge's azimuths are (4π sr count as 2π)."""
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        rows, face = self.faces.rows, self.all_faces()
        bend = face.gradient_norm * dr.sqrt(0.5) / dr.norm(face.n[0] + face.n[1] + face.n[2]) * 3
        weight = face.area * bend * dr.select(rows.shell != 0, 0.5, 1) * dr.pi
        return dr.select(dr.isfinite(weight) & (bend * dr.sqrt(face.area) > FLAT), weight, 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, face = self.face(row, active)
        curve = curve_on(face, t, view)
        seen = self.seen(rows, face, curve.ω)
        return self.point(face, curve.b, curve.ω, curve.weight, active & curve.valid & seen)
