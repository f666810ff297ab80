"""Points of faces of meshes, and of disks, cylinders and spheres, by the surface's own coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi

from ..scene.poses import Poses
from .curves import transform_point, transform_vector


class Surface(IntEnum):
    """Shapes without triangles, by their parametrisation in Mitsuba, in the space of their plugins."""

    DISK = 0  # (u cos 2πv, u sin 2πv, 0)
    CYLINDER = 1  # (cos 2πu, sin 2πu, v)
    SPHERE = 2  # (sin πv cos 2πu, sin πv sin 2πu, cos πv)


@dataclass
class SurfacePoint:
    """A point of a surface, and how it moves with the surface's coordinates. Attached where positions are."""

    x: mi.Point3f  # [m]
    dx_dq0: mi.Vector3f
    dx_dq1: mi.Vector3f

    @property
    def normal(self) -> mi.Normal3f:
        """Unit, by the surface's coordinates."""
        return mi.Normal3f(dr.normalize(dr.cross(self.dx_dq0, self.dx_dq1)))

    def towards(self, dq) -> mi.Vector3f:
        return self.dx_dq0 * dq.x + self.dx_dq1 * dq.y


def point_of_face(positions: mi.Point3f, rows, q: mi.Point2f, active) -> SurfacePoint:
    """The point with the barycentric coordinates `q` on the faces of `rows`, which have the corners v0, v1 and v2."""
    p0, p1, p2 = (dr.gather(mi.Point3f, positions, v, active) for v in (rows.v0, rows.v1, rows.v2))
    e1, e2 = mi.Vector3f(p1 - p0), mi.Vector3f(p2 - p0)
    return SurfacePoint(mi.Point3f(p0 + q.x * e1 + q.y * e2), e1, e2)


def point_of_body(poses: Poses, rows, q: mi.Point2f) -> SurfacePoint:
    """The point with the texture coordinates `q` on the bodies of `rows`, which have a `shape` and a `part`."""
    columns = poses.at(rows.shape)
    x, du, dv = surface_point(rows.part, q)
    return SurfacePoint(transform_point(columns, x), *(transform_vector(columns, d) for d in (du, dv)))


def surface_point(kind: mi.UInt32, uv: mi.Point2f) -> tuple[mi.Point3f, mi.Vector3f, mi.Vector3f]:
    """Point of a `Surface` in its own space, and its derivatives by u and v."""
    disk, sphere = kind == int(Surface.DISK), kind == int(Surface.SPHERE)
    sin_φ, cos_φ = dr.sincos(dr.two_pi * dr.select(disk, uv.y, uv.x))
    sin_θ, cos_θ = dr.sincos(dr.pi * uv.y)
    radial, around = mi.Vector3f(cos_φ, sin_φ, 0), dr.two_pi * mi.Vector3f(-sin_φ, cos_φ, 0)
    x = dr.select(disk, uv.x * radial, dr.select(sphere, sin_θ * radial, radial))
    x.z = dr.select(disk, 0, dr.select(sphere, cos_θ, uv.y))
    du = dr.select(disk, radial, dr.select(sphere, sin_θ * around, around))
    down = dr.pi * mi.Vector3f(cos_θ * cos_φ, cos_θ * sin_φ, -sin_θ)
    dv = dr.select(disk, uv.x * around, dr.select(sphere, down, mi.Vector3f(0, 0, 1)))
    return mi.Point3f(x), du, dv
