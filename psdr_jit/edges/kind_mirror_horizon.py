"""Horizons of smooth-shaded mirrors: curves inside their faces, on which they begin to reflect under the face itself.

A mirror turns the direction of view ω into ω' = ω − 2 (n_s·ω) n_s, with n_s = N/|N| the interpolated normal. Near the
outline that leads under the face, whose own normal is n: what is reflected is the inside of the body, and what a point
x sends along −ω steps where n·ω' = 0. With both sides times |N|² that is

    h = M(x)·ω = 0,        M = |N|² n − 2 (n·N) N,

the face's normal as the mirror shows it. M takes the part of the normal in `kind_within_faces`, but is quadratic on
the face: with N_i = ∂N/∂b_i

    ∂h/∂b_i = 2 (N·N_i) (n·ω) − 2 (n·N_i) (N·ω) − 2 (n·N) (N_i·ω).

However fine the mesh, a grazing mirror reflects all light: the step does not go away, as that of a smooth lobe does.
From the sensor's viewpoint no parametrisation of the curve is at hand: what it sees of these curves is found by lines
across the film (`boundary/chain_search`), and lines through them are for what other surfaces see.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame
from .kind import OnEdge, Use
from .kind_within_faces import CurvesWithinFaces
from .shading_curve import Face


def reflects(mesh: mi.Mesh) -> bool:
    """Is it a mirror, among other things?"""
    return mi.has_flag(mesh.bsdf().flags(), mi.BSDFFlags.DeltaReflection)


def lets_through(mesh: mi.Mesh) -> bool:
    """Do paths go straight on through it, or bend?"""
    flags = mesh.bsdf().flags()
    return mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) or mi.has_flag(flags, mi.BSDFFlags.Null)


@dataclass
class MirroredFace(Face):
    """A face with M as its normal."""

    def normal(self, b: mi.Point2f) -> mi.Normal3f:
        N, n = Face.normal(self, b), dr.normalize(self.n_g)
        return mi.Normal3f(dr.squared_norm(N) * n - 2 * dr.dot(n, N) * N)

    def gradient(self, ω: mi.Vector3f, b: mi.Point2f) -> mi.Vector3f:
        N, n = Face.normal(self, b), dr.normalize(self.n_g)
        rises = []
        for N_i in (mi.Vector3f(self.n[1] - self.n[0]), mi.Vector3f(self.n[2] - self.n[0])):
            turned = dr.dot(N, N_i) * dr.dot(n, ω) - dr.dot(n, N_i) * dr.dot(N, ω) - dr.dot(n, N) * dr.dot(N_i, ω)
            rises.append(2 * turned)
        return self.ascent(*rises)


class MirrorHorizons(CurvesWithinFaces):
    """Where n is the face's normal as the mirror shows it."""

    def of_corners(self, p: list[mi.Point3f], n: list[mi.Normal3f]) -> Face:
        return MirroredFace(p, n)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        return dr.zeros(mi.Float, self.count)

    def line_weights(self, use: Use) -> mi.Float:
        """As of shading outlines, but that M turns twice as fast, and that the face is seen at the angle of M to its
        plane at most. Beside mirrors that move, or see what does, directions are kept: there is no other use.
        """
        if use is not Use.STEP:
            return dr.zeros(mi.Float, self.count)
        face, tilt = self.all_faces(), mi.Float(0)
        n = dr.normalize(face.n_g)
        for b in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
            M = face.normal(mi.Point2f(b))
            tilt += dr.norm(dr.cross(n, M)) / dr.norm(M) / 3
        bend = 2 * face.gradient_norm * dr.sqrt(0.5) / dr.norm(face.n[0] + face.n[1] + face.n[2]) * 3
        weight = face.area * bend * tilt * dr.select(self.faces.rows.shell != 0, 0.5, 1) * dr.pi
        return dr.select(dr.isfinite(weight), weight, 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        """None: see above."""
        rows, face = self.face(row, active)
        eye = mi.Vector3f(view.x, view.y, view.z)
        ω = dr.normalize(view.w * mi.Vector3f(face.p[0]) - eye)
        return self.point(face, mi.Point2f(1 / 3), ω, face.area, mi.Bool(False))
