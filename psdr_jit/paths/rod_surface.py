"""The surface of linear curves, attached (`core.rod`): Mitsuba's own rests on the ray while both move.

A ray of moving origin and direction meets the surface where it meets the tangent plane of the point at (v, n), which
moves as c(v) + r(v) n does. All else, normal, frame and texture coordinates, follows from that point: v is linear in
it. As Mitsuba has none, there are no derivatives by texture coordinates, and so no element of area.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.curve_frame import turns
from ..scene.surfaces import Rods
from .own_surface import of_hit, on_ray, where_active


def rod_surface(
    rods: Rods,
    pi: mi.PreliminaryIntersection3f,
    segment: mi.UInt32,
    ray: mi.Ray3f,
    follow: bool,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """The surface of a linear curve; lanes that are not `active` hold anything finite. `follow`: the point moves with
    the surface, not along the ray.
    """
    o, d, t = where_active(ray, pi, active)
    rod = rods.rod(segment, active)
    x = dr.detach(o) + t * dr.detach(d)
    v, n = (dr.detach(a) for a in rod.place(x))
    on_surface = mi.Point3f(rod.centre(v) + rod.radius(v) * n)
    if follow:  # whose ray may start a little beside that of the hit
        x = dr.detach(on_surface)
    p = mi.Point3f(x)
    if dr.grad_enabled(o, d, rod):
        p = on_surface if follow else on_ray(o, d, t, n, on_surface)
        p = dr.replace_grad(x, p)
    si = dr.zeros(mi.SurfaceInteraction3f)
    v, n = rod.place(p)
    si.p, si.n, si.sh_frame = p, mi.Normal3f(n), mi.Frame3f(n)
    count = dr.gather(mi.UInt32, rods.count, dr.reinterpret_array(mi.UInt32, pi.shape), active)
    si.uv = mi.Point2f(turns(rod.axis[0], n), (v + pi.prim_index) / count)
    return of_hit(si, pi, ray, (o, d, t))
