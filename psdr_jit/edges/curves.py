"""Edges of shapes without triangles: the rim of a disk, the rims and silhouette of a cylinder, that of a sphere.

In the local space of Mitsuba's plugins (unit disk in z = 0, unit cylinder z ∈ [0, 1], unit sphere) each is a curve
x(s), s ∈ [0, 1). Tangency is preserved by affine maps, so a silhouette may be found locally: x with n·(c − x) = 0,
where the viewpoint c is a point, or a direction for parallel projection [do Carmo 1976, §2-4 on contours].
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import pointers
from ..core.upload import uploaded
from ..scene.poses import Poses

#: Each curve is cut into this many pieces, so that hidden or distant parts get their own weight.
PIECES = 64


class Curve(IntEnum):
    DISK_RIM = 0
    CYLINDER_BOTTOM = 1
    CYLINDER_TOP = 2
    CYLINDER_LEFT = 3  # the two silhouette lines
    CYLINDER_RIGHT = 4
    SPHERE_SILHOUETTE = 5


CURVES_OF = {
    "disk": (Curve.DISK_RIM,),
    "cylinder": (Curve.CYLINDER_BOTTOM, Curve.CYLINDER_TOP, Curve.CYLINDER_LEFT, Curve.CYLINDER_RIGHT),
    "sphere": (Curve.SPHERE_SILHOUETTE,),
}


@dataclass
class CurveRows:
    """One entry per piece of a curve; detached device arrays."""

    kind: mi.UInt32  # Curve
    shape: mi.UInt32  # index into the curve set's shapes
    start: mi.Float  # s at the start of the piece; every piece is 1 / PIECES long


@dataclass(frozen=True)
class CurveSet:
    """Curves of disks, cylinders and spheres. `rows` is None when there are none."""

    shapes: tuple[mi.Shape, ...]
    pointers: mi.ShapePtr | None  # to `shapes`, for intersections
    rows: CurveRows | None

    @cached_property
    def poses(self) -> Poses:
        return Poses.of(self.shapes)


@dataclass
class CurvePoint:
    """A point on a curve, local space, for one viewpoint. Detached."""

    x: mi.Point3f
    dx_ds: mi.Vector3f
    outward: mi.Vector3f  # a local direction that leads off the surface, across the curve
    valid: mi.Bool  # the silhouette exists (the viewpoint is outside)


def curve_set(shapes: list[tuple[mi.Shape, str]]) -> CurveSet:
    """Curves of `(shape, plugin name)` pairs."""
    curves = np.array([(curve, i) for i, (_, plugin) in enumerate(shapes) for curve in CURVES_OF[plugin]])
    if not len(curves):
        return CurveSet((), None, None)
    kind, owner = (uploaded(mi.UInt32, np.repeat(column, PIECES)) for column in curves.T)
    rows = CurveRows(kind, owner, uploaded(mi.Float, np.tile(np.arange(PIECES) / PIECES, len(curves))))
    owners = tuple(shape for shape, _ in shapes)
    return CurveSet(owners, pointers(mi.ShapePtr, owners), rows)


def transform_point(columns: tuple[mi.Vector3f, ...], x: mi.Point3f) -> mi.Point3f:
    return mi.Point3f(columns[0] * x.x + columns[1] * x.y + columns[2] * x.z + columns[3])


def transform_vector(columns: tuple[mi.Vector3f, ...], x: mi.Vector3f) -> mi.Vector3f:
    return columns[0] * x.x + columns[1] * x.y + columns[2] * x.z


def local_viewpoint(columns: tuple[mi.Vector3f, ...], view: mi.Vector4f) -> mi.Vector4f:
    """Homogeneous viewpoint in local space: Cramer's rule on the columns (w stays as it is)."""
    a, b, c, o = columns
    v = mi.Vector3f(view.x, view.y, view.z) - view.w * o
    inv_det = dr.rcp(dr.dot(a, dr.cross(b, c)))
    x, y, z = dr.dot(v, dr.cross(b, c)), dr.dot(v, dr.cross(c, a)), dr.dot(v, dr.cross(a, b))
    return mi.Vector4f(x * inv_det, y * inv_det, z * inv_det, view.w)


def is_rim(kind: mi.UInt32) -> mi.Bool:
    """Does the surface end there? At all other curves it turns from the viewer."""
    return (kind == int(Curve.DISK_RIM)) | is_tube_end(kind)


def is_tube_end(kind: mi.UInt32) -> mi.Bool:
    return (kind == int(Curve.CYLINDER_BOTTOM)) | (kind == int(Curve.CYLINDER_TOP))


def curve_centre(kind: mi.UInt32) -> mi.Point3f:
    """A local point inside the shape, from which its contour always exists."""
    on_axis = (kind >= int(Curve.CYLINDER_BOTTOM)) & (kind <= int(Curve.CYLINDER_RIGHT))
    return mi.Point3f(0, 0, dr.select(on_axis, 0.5, 0.0))


def curve_lengths(curves: CurveSet) -> mi.Float:
    """Approximate length of every piece [m] (a contour's depends on the viewpoint); detached."""
    columns = curves.poses.at(curves.rows.shape)
    line = (curves.rows.kind == int(Curve.CYLINDER_LEFT)) | (curves.rows.kind == int(Curve.CYLINDER_RIGHT))
    round_trip = dr.pi * (dr.norm(columns[0]) + dr.norm(columns[1]))
    return dr.select(line, dr.norm(columns[2]), round_trip) / PIECES


def curve_scale(columns: tuple[mi.Vector3f, ...], point: CurvePoint) -> mi.Float:
    """Size of the shape across a curve [m]: the radius also at the rims of a long tube."""
    return dr.minimum(dr.norm(transform_vector(columns, point.outward)), dr.norm(columns[0]))


def curve_point(kind: mi.UInt32, s: mi.Float, view: mi.Vector4f) -> CurvePoint:
    """Evaluate curve `kind` at parameter `s` for the local viewpoint `view`. Detached, branch-free."""
    sin, cos = dr.sincos(dr.two_pi * s)
    rim_z = dr.select(kind == int(Curve.CYLINDER_TOP), 1.0, 0.0)
    x = mi.Point3f(cos, sin, rim_z)
    dx = dr.two_pi * mi.Vector3f(-sin, cos, 0)
    tube_end = is_tube_end(kind)
    outward = dr.select(tube_end, mi.Vector3f(0, 0, 2 * rim_z - 1), mi.Vector3f(cos, sin, 0))
    valid = mi.Bool(True)

    left, right = kind == int(Curve.CYLINDER_LEFT), kind == int(Curve.CYLINDER_RIGHT)
    line = left | right
    rho = dr.norm(mi.Vector2f(view.x, view.y))
    φ = dr.atan2(view.y, view.x) + dr.select(left, 1.0, -1.0) * dr.acos(dr.clip(view.w / rho, -1, 1))
    sin, cos = dr.sincos(φ)
    x[line], dx[line], outward[line] = mi.Point3f(cos, sin, s), mi.Vector3f(0, 0, 1), mi.Vector3f(cos, sin, 0)
    valid &= ~line | (rho > view.w)

    ball = kind == int(Curve.SPHERE_SILHOUETTE)
    axis = mi.Vector3f(view.x, view.y, view.z)
    distance = dr.norm(axis)
    axis /= distance
    height = view.w / distance
    radius = dr.safe_sqrt(1 - dr.square(height))
    a, b = mi.coordinate_system(axis)
    sin, cos = dr.sincos(dr.two_pi * s)
    on_circle = cos * a + sin * b
    point = mi.Point3f(height * axis + radius * on_circle)
    x[ball], outward[ball] = point, mi.Vector3f(point)
    dx[ball] = dr.two_pi * radius * (cos * b - sin * a)
    valid &= ~ball | (distance > view.w)
    return CurvePoint(x, dx, outward, valid)


def own_surface(kind: mi.UInt32, x: mi.Point3f, ω: mi.Vector3f, turn: mi.Float, inset: mi.Float) -> mi.Point3f:
    """The point of the shape's own surface that is seen along ω (local) just inside of the curve point `x`. Detached.

    A rim is left by `inset` of the radius of a disk or the length of a tube. A silhouette turns towards the viewer by
    the angle `turn`, about the tangent of the contour: of the part of ω that is at right angles to a tube's axis.
    """
    towards = -mi.Vector3f(ω)
    on_tube = (kind == int(Curve.CYLINDER_LEFT)) | (kind == int(Curve.CYLINDER_RIGHT))
    towards.z[on_tube] = 0
    n = mi.Vector3f(x.x, x.y, dr.select(on_tube, 0, x.z))
    towards -= dr.dot(towards, n) * n
    length = dr.norm(towards)
    towards = dr.select(length > 0, towards / length, 0)
    sin, cos = dr.sincos(turn)
    turned = mi.Point3f(x + (cos - 1) * n + sin * towards)

    tube_end = is_tube_end(kind)
    along_tube = mi.Point3f(x.x, x.y, dr.select(kind == int(Curve.CYLINDER_TOP), 1 - inset, inset))
    on_disk = mi.Point3f(x * (1 - inset))
    return dr.select(tube_end, along_tube, dr.select(kind == int(Curve.DISK_RIM), on_disk, turned))
