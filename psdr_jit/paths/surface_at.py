"""The surface that a ray meets, on curves as on everything else: the one place that chooses who evaluates it.

In a scene of many meshes and spheres it is looked up (`tabled_surface`). On a curve (`core.tube_axis`) the material
point keeps its v and its place on the circle,

    x(θ) = c + r a,        a the part of its former direction at right angles to c', of unit length

A ray of moving origin and direction meets the surface where it meets the tangent plane of that point, and there

    v̇ = [(ẋ − ċ)·c' + ρ·ċ'] / B

from (x − c(v))·c'(v) = 0. All else, normal, frame and texture coordinates, follows from x and v.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.curve_frame import turns
from ..core.records import Hit
from ..core.tube_axis import Axis
from ..scene.surfaces import Splines, Surfaces
from .cylinder_surface import cylinder_surface
from .ellipsoid_surface import ellipsoid_surface
from .grid_surface import grid_surface
from .own_surface import of_hit, on_ray, where_active
from .rod_surface import rod_surface
from .tabled_surface import tabled_surface


def surface_at(
    surfaces: Surfaces | None, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, flags, active: mi.Bool | bool = True
) -> mi.SurfaceInteraction3f:
    """`pi.compute_surface_interaction(ray, flags, active)`, attached to the ray and to the shape, curves included.

    With `RayFlags.FollowShape` points stay on their material.
    """
    if surfaces is None:
        return pi.compute_surface_interaction(ray, flags, active)
    if surfaces.meshes is not None:
        return tabled_surface(surfaces.meshes, pi, ray, flags, active)
    families = [(surfaces.splines, _spline_surface), (surfaces.rods, rod_surface),
                (surfaces.ellipsoids, ellipsoid_surface)]  # fmt: skip
    families += [(grid, grid_surface) for grid in surfaces.grids]
    follow = int(flags) & int(mi.RayFlags.FollowShape) != 0
    if surfaces.cylinders is not None and not follow and (dr.grad_enabled(ray) or surfaces.cylinders.attached()):
        families.append((surfaces.cylinders, cylinder_surface))
    met = [(f, of, *f.segment(pi, active & pi.is_valid())) for f, of in families if f is not None]
    elsewhere = mi.Bool(active)  # a copy: the caller's mask is not ours to change
    for *_, on_curve in met:
        elsewhere &= ~on_curve
    si = pi.compute_surface_interaction(ray, flags, elsewhere)
    for curves, of, segment, on_curve in met:
        own = of(curves, pi, segment, ray, follow, on_curve)
        # field by field: a whole interaction would be selected with its instance and its differentials
        for name in ("t", "time", "p", "n", "uv", "sh_frame", "dp_du", "dp_dv", "wi", "prim_index", "shape"):
            setattr(si, name, dr.select(on_curve, getattr(own, name), getattr(si, name)))
    si.wavelengths = ray.wavelengths
    return si


def surface_of(
    surfaces: Surfaces | None, hit: Hit, active: mi.Bool | bool = True, flags=mi.RayFlags.All
) -> mi.SurfaceInteraction3f:
    """The surface at the end of `hit`. Detached, unless `flags` follow the shape."""
    return surface_at(surfaces, hit.intersection(), mi.Ray3f(hit.o, hit.d), flags, active)


def _spline_surface(
    tubes: Splines,
    pi: mi.PreliminaryIntersection3f,
    segment: mi.UInt32,
    ray: mi.Ray3f,
    follow: bool,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """The surface of a curve; lanes that are not `active` hold anything finite."""
    o, d, t = where_active(ray, pi, active)
    v = mi.Float(pi.prim_uv.x)
    axis = tubes.axis(segment, v, active)
    x = dr.detach(o) + t * dr.detach(d)
    if follow:  # whose ray may start a little beside that of the hit
        x = mi.Point3f(dr.detach(_material(axis, x)))
    p = mi.Point3f(x)
    if dr.grad_enabled(o, d, axis):
        moved, n = _material(axis, x), dr.detach(axis.normal(x - axis.c))
        p = mi.Point3f(moved if follow else on_ray(o, d, t, n, moved))
        p = dr.replace_grad(x, p)
        v = dr.replace_grad(v, dr.dot(p - axis.c, axis.dc) / dr.detach(axis.bend(x - axis.c)))
        axis = tubes.axis(segment, v, active)
    si = _geometry(axis, p)
    shape = dr.reinterpret_array(mi.UInt32, pi.shape)
    si.uv.y = (v + pi.prim_index) / dr.gather(mi.UInt32, tubes.count, shape, active)
    si.dp_dv *= dr.gather(mi.UInt32, tubes.count, shape, active)
    return of_hit(si, pi, ray, (o, d, t))


def _material(axis: Axis, x: mi.Point3f) -> mi.Vector3f:
    """Where the material point goes that is at `x` (detached)."""
    a, _, _ = axis.circle(dr.detach(x - axis.c))
    return axis.c + axis.r * a


def _geometry(axis: Axis, p: mi.Point3f) -> mi.SurfaceInteraction3f:
    """Normal, frame, tangents by (u, segment) and u at a point `p` of the circle of `axis`, all attached to both."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    ρ = p - axis.c
    a, b, _ = axis.circle(ρ)
    si.p = p
    si.n = mi.Normal3f(dr.normalize(axis.normal(ρ)))
    si.sh_frame = mi.Frame3f(b, dr.cross(si.n, b), si.n)
    along = dr.select(axis.bend(ρ) > 0, axis.bend(ρ), 0) / dr.squared_norm(axis.dc)
    si.dp_du = dr.two_pi * axis.r * b
    si.dp_dv = along * axis.dc + axis.dr * a
    si.uv = mi.Point2f(turns(dr.normalize(axis.dc), a), 0)
    return si
