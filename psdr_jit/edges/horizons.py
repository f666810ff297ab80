"""Horizons of coarse smooth-shaded faces: the plane of a face parts what its points see from what their body hides.

Next-event estimation and sampled directions start on the side of the face to which they lead, so that the directions
d from a point x are cut by the great circle n·d = 0, n the normal of the *face*: above it the ray is free, below it
runs inside of the body and ends on its back (on an open sheet it is free as well, and nothing steps). The BSDF times
cosine knows the *shading* normal alone. With flat shading it is 0 on that circle; on a smooth-shaded face it is not,

    ∫dA(x) W ∫dd f(x, d) cos_s(d) L(x, d)        steps by f cos_s (L_above − L_below) at n·d = 0,

on the part of the circle where n_s·d > 0. In three dimensions, x on the face and the angle φ on the circle, with
x_B = x + r_B ω the point of the *plane* at the distance r_B in the direction ω, v_B the velocity of the plane there
(that of the face's corners, extended), the boundary integral of an edge has this limit:

    ∫dA(x) ∫dφ  ± L · W f cos_s · (1/r_B) · n·[ v_B − (1 − r_B/r_S) u_D − (r_B/r_S) u_S ]

ω from x to the source x_S, the sign as for an edge whose n_perp is n. As u_D slides within the plane, n·u_D is that of
the corners, and how x moves does not matter: only how the plane turns, and in the material form, or towards a light,
how x_S crosses it. (x_B at x_S for these, anywhere for the others.)

No edge contains this: of a segment that grazes its own face the edge of the face sees an empty set of lines. Seen from
the other end, an edge-on face takes up no solid angle. Point lights and directions meet whole faces at once: they have
steps in time and no derivative there.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.lift import start_height
from .kind import Side, Sight
from .location import EdgeLocation
from .shading_curve import Face
from .smooth_faces import FaceRows, SmoothFaces

#: Share of the directions that are drawn on the side of the shading normal from which a closed body is seen.
IN_FRONT = 0.9


@dataclass
class Targets:
    """What horizons are asked about: balls around lights, or the whole circle. One entry per target; detached."""

    centre: mi.Point3f  # [m]
    radius: mi.Float  # 0: directions all around
    emitter: mi.UInt32  # registry index; 0: whatever is met


@dataclass
class HorizonPoint:
    """A point of a face and a direction in its plane; detached, one entry per sample."""

    x: mi.Point3f
    ω: mi.Vector3f  # unit
    n: mi.Vector3f  # unit, of the face
    size: mi.Float  # of the face [m]
    offset: mi.Float  # at which Mitsuba starts rays above and below the face [m]
    pdf: mi.Float  # per area and angle, given the row
    target: mi.UInt32
    pi: mi.PreliminaryIntersection3f  # x on its face
    valid: mi.Bool


@dataclass(frozen=True)
class Horizons:
    """A table of rows, see `sampling.rows.Table`: a face and a target each, those of one face one after the other."""

    faces: SmoothFaces
    targets: Targets

    @property
    def per_face(self) -> int:
        return dr.width(self.targets.radius)

    @property
    def count(self) -> int:
        return dr.width(self.faces.rows.prim) * self.per_face

    def face(self, row: mi.UInt32, active: mi.Bool | bool = True) -> tuple[FaceRows, Face]:
        """Of these rows, detached."""
        rows = dr.gather(FaceRows, self.faces.rows, row // self.per_face, mi.Bool(active))
        return rows, Face(*self.faces.corners(rows.corner, mi.Bool(active)))

    def target(self, row: mi.UInt32) -> Targets:
        return dr.gather(Targets, self.targets, row % self.per_face)

    def moves(self, at: EdgeLocation) -> mi.Bool:
        return dr.gather(mi.Bool, self.faces.rows.moves, at.row // self.per_face)

    def displacement(self, at: EdgeLocation, ω: mi.Vector3f) -> mi.Vector3f:
        """That of the corners at the point x of their plane, of which they say all that moves the plane."""
        rows, face = self.face(at.row)
        b = face.barycentric(at.x - face.p[0])
        p, _ = self.faces.attached_corners(rows.corner, mi.Bool(True))
        moved = [mi.Vector3f(corner - dr.detach(corner)) for corner in p]
        return (1 - b.x - b.y) * moved[0] + b.x * moved[1] + b.y * moved[2]

    def turn(self, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f) -> mi.Vector3f:
        """As of `EdgeTable`: nothing depends on the direction."""
        return mi.Vector3f(0)

    def within_surfaces(self, row: mi.UInt32) -> mi.Bool | None:
        """As of `EdgeTable`: no horizon does."""
        return None

    def side(self, sight: Sight, which: mi.UInt32) -> Side:
        """Above or below the face: whatever a ray meets."""
        return Side.found_by(sight.beside(which))

    def draw(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f) -> HorizonPoint:
        """A point of the face, uniform, and a direction towards the target; from numbers uniform in [0, 1)."""
        rows, face = self.face(row)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(t, u.x))
        x, n = face.at(b), dr.normalize(face.n_g)
        to = self.target(row)
        towards, half, seen = _angle_of_ball(x, n, to)
        ω_ball = _on_circle(towards, n, half * (2 * u.y - 1))
        ω_all, pdf_all, lit = _all_around(face.normal(b), n, rows.shell, u.y)
        ball = to.radius > 0
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid, pi.t, pi.prim_index, pi.prim_uv = mi.Bool(True), face.size, rows.prim, b
        pi.shape = dr.gather(mi.ShapePtr, self.faces.shapes, rows.shape)
        return HorizonPoint(
            x=x,
            ω=dr.select(ball, ω_ball, ω_all),
            n=n,
            size=face.size,
            offset=start_height(x),
            pdf=dr.select(ball, dr.rcp(2 * half), pdf_all) / face.area,
            target=row % self.per_face,
            pi=pi,
            valid=dr.select(ball, seen, lit) & (face.area > 0),
        )


def _on_circle(axis: mi.Vector3f, n: mi.Vector3f, φ: mi.Float) -> mi.Vector3f:
    """The direction at the angle φ from `axis`, which is perpendicular to n."""
    sin, cos = dr.sincos(φ)
    return dr.normalize(cos * axis + sin * dr.cross(n, axis))


def _angle_of_ball(x: mi.Point3f, n: mi.Vector3f, to: Targets) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Where the plane through x meets the ball: `(middle of the directions, half their angle, whether it does)`."""
    d = to.centre - x
    height = dr.dot(n, d)
    d -= height * n
    far, radius = dr.norm(d), dr.safe_sqrt(dr.square(to.radius) - dr.square(height))
    inside = far <= radius
    any_d, _ = mi.coordinate_system(n)
    half = dr.select(inside, dr.pi, dr.safe_asin(radius / far))
    return dr.select(inside, any_d, d / far), half, half > 0


def _all_around(
    n_s: mi.Normal3f, n: mi.Vector3f, shell: mi.Float, u: mi.Float
) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Directions as likely as |n_s·ω|, most of them on the side from which a closed body is seen: `(ω, pdf, valid)`."""
    outward = dr.select(dr.dot(n_s, n) * shell < 0, -1.0, 1.0)
    axis = n_s - n * dr.dot(n_s, n)
    length = dr.norm(axis)
    front = dr.select(shell != 0, IN_FRONT, 0.5)
    ahead = u < front
    rest = dr.select(ahead, u / front, (u - front) / (1 - front))
    sin = 2 * rest - 1
    cos = dr.safe_sqrt(1 - dr.square(sin))
    side = dr.select(ahead, 1.0, -1.0) * outward
    axis *= dr.select(length > 0, side / length, 0)
    pdf = dr.select(ahead, front, 1 - front) * cos / 2
    return dr.normalize(cos * axis + sin * dr.cross(n, axis)), pdf, (length > 0) & (cos > 0)
