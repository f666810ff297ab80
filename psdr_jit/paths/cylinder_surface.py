"""The surface of cylinders, attached. Mitsuba finds it by the quadratic of the ray, in single precision.

Near an outline the discriminant of that is the small difference of large numbers: seen from a hundred radii away, its
derivative is wrong by half at cosines below .03, and by 2 per cent (rms) from .1 to .3; now and then it is none at all.
Here the attached ray meets the tangent plane of the material point (`own_surface`), and Mitsuba is asked for what it
knows of that place with a ray along the normal, whose quadratic is well behaved, whatever the pose of the cylinder.
Points that follow the surface are Mitsuba's own: it asks no quadratic for them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.surfaces import Cylinders
from .own_surface import of_hit, on_ray, where_active

#: How far off the surface the ray along the normal starts, in radii: below 2, for it may start inside.
OFF = 0.5


def cylinder_surface(
    cylinders: Cylinders,
    pi: mi.PreliminaryIntersection3f,
    index: mi.UInt32,
    ray: mi.Ray3f,
    follow: bool,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """The surface of a cylinder met by an attached ray; lanes that are not `active` hold anything. Called as its
    neighbours are; `surface_at` does not with `follow`.
    """
    o, d, t = line = where_active(ray, pi, active)
    held = mi.Ray3f(dr.detach(o), dr.detach(d), 0, ray.wavelengths)
    material = pi.compute_surface_interaction(held, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    n, off = dr.detach(material.n), dr.detach(dr.norm(material.dp_du)) * (OFF / dr.two_pi)
    p = dr.replace_grad(held(t), on_ray(o, d, t, n, material.p))
    towards = mi.Ray3f(mi.Point3f(p + off * n), -n, 0, ray.wavelengths)
    beneath = mi.PreliminaryIntersection3f(pi)
    beneath.t = off
    si = beneath.compute_surface_interaction(towards, mi.RayFlags.All, active)
    si.p = mi.Point3f(p)
    return of_hit(si, pi, ray, line)
