"""What surfaces that are evaluated here have in common: where an attached ray meets them, and what is known there.

A ray of moving origin and direction meets a surface where it meets the tangent plane of a material point, which moves
with the surface.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def where_active(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool):
    """`(o, d, t)` of attached rays and their hits; lanes elsewhere hold numbers that nothing is divided by."""
    o, d = (dr.select(active, a, b) for a, b in ((ray.o, mi.Point3f(0)), (ray.d, mi.Vector3f(0, 0, 1))))
    return o, d, dr.select(active, pi.t, 0)


def on_ray(o: mi.Point3f, d: mi.Vector3f, t: mi.Float, n: mi.Vector3f, moved: mi.Point3f) -> mi.Point3f:
    """Where the attached ray, whose hit is at the distance `t`, meets the plane with normal `n` (detached) that moves
    as the attached point `moved` does.
    """
    return o + d * dr.replace_grad(t, dr.dot(n, moved - o) / dr.dot(n, d))


def of_hit(
    si: mi.SurfaceInteraction3f, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, line: tuple
) -> mi.SurfaceInteraction3f:
    """`si`, of which point and frames are known, with all that follows from the hit; `line`: of `where_active`."""
    o, d, t = line
    si.t = dr.replace_grad(t, dr.dot(si.p - o, dr.detach(d)))
    si.time = ray.time
    si.wi = si.sh_frame.to_local(-d)
    si.prim_index = pi.prim_index
    si.shape = pi.shape
    return si
