"""The surface of ellipsoids, attached (`core.ellipsoid`): Mitsuba's own rests on the ray while both move.

A ray of moving origin and direction meets the surface where it meets the tangent plane of the material point m, which
moves as c + A m does. As Mitsuba has none, there are no texture coordinates, and so no element of area.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.surfaces import Ellipsoids
from .own_surface import of_hit, on_ray, where_active


def ellipsoid_surface(
    bodies: Ellipsoids,
    pi: mi.PreliminaryIntersection3f,
    index: mi.UInt32,
    ray: mi.Ray3f,
    follow: bool,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """The surface of an ellipsoid; lanes that are not `active` hold anything finite. `follow`: the point moves with
    the surface, not along the ray.
    """
    o, d, t = where_active(ray, pi, active)
    body = bodies.ellipsoid(index, active)
    x = mi.Point3f(dr.detach(o) + t * dr.detach(d))
    m = dr.normalize(dr.detach(body.on_sphere(x - body.c)))
    if follow:  # whose ray may start a little beside that of the hit
        x = mi.Point3f(dr.detach(body.point(m)))
    p = x
    if dr.grad_enabled(o, d, body):
        moved, n = body.point(m), dr.detach(body.normal(m))
        p = moved if follow else on_ray(o, d, t, n, moved)
        p = mi.Point3f(dr.replace_grad(x, p))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = p
    si.n = mi.Normal3f(body.normal(body.on_sphere(p - body.c)))
    si.sh_frame = mi.Frame3f(si.n)
    return of_hit(si, pi, ray, (o, d, t))
