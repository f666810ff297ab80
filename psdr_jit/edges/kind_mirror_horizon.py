"""Horizons of smooth-shaded mirrors: curves inside their faces, on which they begin to reflect under the face itself.

A mirror turns the direction of view ω into ω' = ω − 2 (n_s·ω) n_s, with n_s = N/|N| the interpolated normal. Near the
outline that leads under the face, whose own normal is n: what is reflected is the inside of the body, and what a point
x sends along −ω steps where n·ω' = 0. With both sides times |N|² that is

    h = M(x)·ω = 0,        M = |N|² n − 2 (n·N) N,

the face's normal as the mirror shows it. M takes the part of the normal in `kind_within_faces`, but is quadratic on
the face: with N_i = ∂N/∂b_i

    ∂h/∂b_i = 2 (N·N_i) (n·ω) − 2 (n·N_i) (N·ω) − 2 (n·N) (N_i·ω).

However fine the mesh, a grazing mirror reflects all light: the step does not go away, as that of a smooth lobe does.

*From a viewpoint* o the curve is met, as in `kind_shading`, on the way x = A + r (E(s) − A) from a corner to a point of
the opposite side, where

    h |x − o| = |N|² n·(x − o) − 2 (n·N) N·(x − o) = Σ_k g_k r^k

is a cubic in r, as n·(x − o) is the same all over the face. Between the places where its slope is 0 it has one root at
most, which is found by halving.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .kind import Use
from .kind_within_faces import CurvesWithinFaces
from .shading_curve import ALTERNATIONS, CurvePoint, Face, LoneCorner

#: Halvings of an interval in r: as far as float32 tells its ends apart.
HALVINGS = 24

#: What rounding adds to the height above a face at which horizons may be seen, as a factor.
ROUNDED = 1.001

#: Corners in barycentric coordinates.
CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


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

    def tilt(self, b: tuple[float, float]) -> mi.Float:
        """Sine of the angle between M and the face's normal: in other directions no mirror reflects along the face."""
        M, n = self.normal(mi.Point2f(b)), dr.normalize(self.n_g)
        return dr.norm(dr.cross(n, M)) / dr.norm(M)

    def may_cross(self, view: mi.Vector4f, slack: mi.Float) -> mi.Bool:
        """False where no point of the face reflects along it from any viewpoint within `slack` of `view` [m].

        No interpolated normal is farther off the face than that of a corner, by α, so that |n·ω| ≤ sin 2α.
        """
        n, eye = dr.normalize(self.n_g), mi.Vector3f(view.x, view.y, view.z)
        steep, far = mi.Float(0), mi.Float(0)
        for p, n_s in zip(self.p, self.n, strict=True):
            cos = dr.abs(dr.dot(n, n_s)) / dr.norm(n_s)
            steep = dr.maximum(steep, dr.select(dr.square(cos) > 0.5, 2 * cos * dr.safe_sqrt(1 - dr.square(cos)), 1))
            far = dr.maximum(far, dr.norm(view.w * mi.Vector3f(p) - eye))
        height = dr.abs(dr.dot(n, view.w * mi.Vector3f(self.p[0]) - eye))
        return height <= ROUNDED * steep * (far + slack) + slack

    def curve(self, s: mi.Float, view: mi.Vector4f) -> CurvePoint:
        """The curve on the way from a corner, the one that is alone on its side of it, to the point s of its side.

        Where that way crosses the curve more than once, the points take turns, of many small intervals of s each.
        """
        eye, w, n = mi.Vector3f(view.x, view.y, view.z), view.w, dr.normalize(self.n_g)
        D = [w * mi.Vector3f(p) - eye for p in self.p]
        N = [mi.Vector3f(corner) for corner in self.n]
        c = dr.dot(n, D[0])
        up = [dr.squared_norm(N[k]) * c > 2 * dr.dot(n, N[k]) * dr.dot(N[k], D[k]) for k in range(3)]
        corner = LoneCorner.of(up)
        D, N, p = (corner.first(values) for values in (D, N, self.p))
        across, along = p[2] - p[1], p[1] + s * (p[2] - p[1]) - p[0]
        N0, N1, D0, D1 = N[0], N[1] + s * (N[2] - N[1]) - N[0], D[0], w * along
        z = dr.dot(N0, D0), dr.dot(N0, D1) + dr.dot(N1, D0), dr.dot(N1, D1)
        q = dr.squared_norm(N0), 2 * dr.dot(N0, N1), dr.squared_norm(N1)
        p0, p1 = dr.dot(n, N0), dr.dot(n, N1)
        g = (c * q[0] - 2 * p0 * z[0], c * q[1] - 2 * (p0 * z[1] + p1 * z[0]),
             c * q[2] - 2 * (p0 * z[2] + p1 * z[1]), -2 * p1 * z[2])  # fmt: skip
        r, count = _root(g, s)
        towards = D0 + r * D1
        slope = dr.abs(g[1] + r * (2 * g[2] + 3 * r * g[3]))
        distance = dr.norm(towards)
        weight = count * dr.norm(dr.cross(r * across, along)) * distance / slope
        return CurvePoint(corner.at(s, r), towards / distance, weight, (count > 0) & (slope > 0))


def _root(g: tuple, s: mi.Float) -> tuple[mi.Float, mi.Float]:
    """One of the roots in (0, 1) of the cubic Σ g_k r^k, and how many there are; s: by which they take turns."""

    def at(r: mi.Float) -> mi.Float:
        return g[0] + r * (g[1] + r * (g[2] + r * g[3]))

    # where the slope g1 + 2 g2 r + 3 g3 r² is 0
    k = -(g[2] + dr.select(g[2] < 0, -1.0, 1.0) * dr.safe_sqrt(dr.square(g[2]) - 3 * g[1] * g[3]))
    bends = [dr.select(dr.isfinite(e) & (e > 0) & (e < 1), e, 1) for e in (k / (3 * g[3]), g[1] / k)]
    ends = [mi.Float(0), dr.minimum(*bends), dr.maximum(*bends), mi.Float(1)]
    high = [at(end) > 0 for end in ends]
    crosses = [high[i] != high[i + 1] for i in range(3)]
    count = sum(dr.select(there, mi.Float(1), 0) for there in crosses)
    turn = s * ALTERNATIONS
    left = dr.floor((turn - dr.floor(turn)) * count)
    lo, hi, rises = mi.Float(0), mi.Float(1), mi.Bool(True)
    for i, there in enumerate(crosses):
        taken = there & (left == 0)
        lo, hi = dr.select(taken, ends[i], lo), dr.select(taken, ends[i + 1], hi)
        rises = dr.select(taken, high[i + 1], rises)
        left -= dr.select(there, mi.Float(1), 0)
    for _ in range(HALVINGS):
        middle = 0.5 * (lo + hi)
        before = (at(middle) > 0) != rises
        lo, hi = dr.select(before, middle, lo), dr.select(before, hi, middle)
    return 0.5 * (lo + hi), count


class MirrorHorizons(CurvesWithinFaces):
    """Where n is the face's normal as the mirror shows it."""

    def of_corners(self, p: list[mi.Point3f], n: list[mi.Normal3f]) -> Face:
        return MirroredFace(p, n)

    def other_curve(self, face: Face) -> Face:
        return Face(face.p, face.n)

    def line_weights(self, use: Use) -> mi.Float:
        """As of shading outlines, but that M turns twice as fast, and that the face is seen at the angle of M to its
        plane at most. Beside mirrors that move, or see what does, directions are kept: there is no other use.
        """
        if use is not Use.STEP:
            return dr.zeros(mi.Float, self.count)
        face = self.all_faces()
        tilt = sum(face.tilt(b) for b in CORNERS) / 3
        return 2 * tilt * self.bends(face)
