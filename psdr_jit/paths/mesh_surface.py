"""The surface of meshes, attached, from their tables: as Mitsuba's `Mesh::compute_surface_interaction` has it.

A point of a triangle is p = b₀ p₀ + b₁ p₁ + b₂ p₂. Where a ray meets it, b₁, b₂ and the distance move as the
intersection by Möller and Trumbore does [1997, "Fast, minimum storage ray-triangle intersection", JGT 2(1)], of which
the derivative alone is used; a point that follows the shape keeps its b. All else is a function of b and the corners.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.mesh_tables import FLIPPED, MOVES, SMOOTH, TEXTURED, MeshTables

#: Corners that lanes without a hit get: nothing is divided by 0.
ANY_TRIANGLE = ((0, 0, 0), (1, 0, 0), (0, 1, 0))


def mesh_surface(
    tables: MeshTables, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, flags: mi.RayFlags, active: mi.Bool
) -> dict:
    """What meshes say of their surface where `active`, by field; anything finite elsewhere."""
    follow, frames, charts = (int(flags) & int(flag) != 0 for flag in (
        mi.RayFlags.FollowShape, mi.RayFlags.ShadingFrame, mi.RayFlags.UV | mi.RayFlags.dPdUV))  # fmt: skip
    corners = _Corners(tables, pi, active)
    of_mesh = corners.of("positions", mi.Point3f)
    p = [dr.select(active, x, mi.Point3f(*other)) for x, other in zip(of_mesh, ANY_TRIANGLE, strict=True)]
    e1, e2 = p[1] - p[0], p[2] - p[0]
    t, b = mi.Float(pi.t), mi.Point2f(pi.prim_uv)
    if not follow and dr.grad_enabled(p, ray.o, ray.d):
        t, b = _met(ray, p[0], e1, e2, t, b)
    x, n = mi.Point3f(_blend(p, b)), dr.normalize(dr.cross(e1, e2))
    if follow:
        t = dr.sqrt(dr.squared_norm(x - ray.o) / dr.squared_norm(ray.d))
    uv, dp_du, dp_dv = _charted(corners, b, e1, e2, n) if charts and tables.textured else (b, e1, e2)
    shading = n
    if frames and tables.smooth:
        smooth = corners.has(SMOOTH)
        blended = mi.Vector3f(_blend(corners.of("normals", mi.Normal3f, smooth), b))
        shading = dr.select(smooth, dr.normalize(dr.select(smooth, blended, n)), n)
    outward = dr.select(corners.has(FLIPPED), mi.Float(-1), mi.Float(1))
    return {"t": t, "p": x, "n": mi.Normal3f(n * outward), "uv": mi.Point2f(uv), "dp_du": dp_du, "dp_dv": dp_dv,
            "shading": mi.Normal3f(shading * outward)}  # fmt: skip


def _blend(corners: list, b: mi.Point2f):
    """What interpolates values at the corners."""
    return dr.fma(corners[0], 1 - b.x - b.y, dr.fma(corners[1], b.x, corners[2] * b.y))


class _Corners:
    """Where the corners of the triangles that were met are found, and what is known of their meshes."""

    def __init__(self, tables: MeshTables, pi: mi.PreliminaryIntersection3f, hit: mi.Bool):
        self._tables, self._hit = tables, hit
        shape = dr.reinterpret_array(mi.UInt32, pi.shape)
        self._traits = dr.gather(mi.UInt32, tables.traits, shape, hit)
        face = dr.gather(mi.UInt32, tables.first_face, shape, hit) + pi.prim_index
        vertices = dr.gather(mi.Vector3u, tables.faces, face, hit)
        self._vertices = [vertices.x, vertices.y, vertices.z]
        if tables.moving is not None:
            shift = dr.gather(mi.UInt32, tables.shift, shape, hit)
            self._moving = [vertex + shift for vertex in self._vertices]

    def has(self, trait: int) -> mi.Bool:
        return self._hit & ((self._traits & trait) != 0)

    def of(self, name: str, kind: type, among: mi.Bool | bool = True) -> list:
        """Values of type `kind` at the three corners, attached where meshes move; 0 elsewhere than `among`."""
        there = self._hit & among
        resting = there if self._tables.moving is None else there & ~self.has(MOVES)
        found = [dr.gather(kind, getattr(self._tables.vertices, name), k, resting) for k in self._vertices]
        if self._tables.moving is None:
            return found
        own, moves = getattr(self._tables.moving.vertices, name), there & self.has(MOVES)
        return [dr.select(moves, dr.gather(kind, own, k, moves), a) for k, a in zip(self._moving, found, strict=True)]


def _met(ray: mi.Ray3f, p0: mi.Point3f, e1: mi.Vector3f, e2: mi.Vector3f, t: mi.Float, b: mi.Point2f):
    """`(t, b)` with the derivatives of a ray that meets a triangle: the ray's own, and those of the corners."""
    across = dr.cross(ray.d, e2)
    scale = dr.rcp(dr.dot(e1, across))
    from_corner = ray.o - p0
    up = dr.cross(from_corner, e1)
    b1, b2, distance = (dr.dot(u, v) * scale for u, v in ((from_corner, across), (ray.d, up), (e2, up)))
    return dr.replace_grad(t, distance), dr.replace_grad(b, mi.Point2f(b1, b2))


def _charted(
    corners: _Corners, b: mi.Point2f, e1: mi.Vector3f, e2: mi.Vector3f, n: mi.Vector3f
) -> tuple[mi.Point2f, mi.Vector3f, mi.Vector3f]:
    """Texture coordinates, ∂p/∂u and ∂p/∂v: barycentric where a mesh has none, and any two directions at right angles
    where those of a triangle do not span a plane.
    """
    textured = corners.has(TEXTURED)
    uv = corners.of("texcoords", mi.Point2f, textured)
    a, c = uv[1] - uv[0], uv[2] - uv[0]
    area = dr.fma(a.x, c.y, -a.y * c.x)
    spans = area != 0
    scale = dr.rcp(dr.select(spans, area, 1))
    s, t = mi.coordinate_system(n)
    dp_du = dr.select(spans, (c.y * e1 - a.y * e2) * scale, s)
    dp_dv = dr.select(spans, (a.x * e2 - c.x * e1) * scale, t)
    return dr.select(textured, _blend(uv, b), b), dr.select(textured, dp_du, e1), dr.select(textured, dp_dv, e2)
