"""What lies so close in front of an edge that rays which are aimed at it leave it out."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.lift import seen_side
from ..paths.rays import ROUNDING


def hidden_close_by(scene: mi.Scene, o: mi.Point3f, body: mi.Point3f, scale: mi.Float, active: mi.Bool) -> mi.Bool:
    """Does the way from `o`, close to an edge, to its `body` meet a surface that has this behind it by more than
    rounding?

    `scale`: of the lengths that have been rounded [m]. Faces in line with the viewer are met there as well, but the
    edge lies in their plane. Detached.
    """
    way = body - o
    length = dr.norm(way)
    ray = mi.Ray3f(o, way / length)
    ray.maxt = length
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
    depth = dr.dot(seen_side(si, ray.d), si.p - body)
    return active & pi.is_valid() & (depth > ROUNDING * scale)
