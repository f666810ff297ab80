"""Does the sensor see a path vertex? What walks that connect their vertices to the sensor have in common."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.lift import start_height
from ..core.sensor_frame import SensorFrame, View
from .rays import ROUNDING, SHADOW_EPSILON, see_through_emitters

#: Share of the height at which rays start within which what is in front of a surface does not hide it, and the least
#: cosine by which that becomes a length along a ray.
TOUCHES, LEAST_COSINE = 0.1, 0.05


def on_film(frame: SensorFrame, view: View, margin: mi.Float | float = 0.0) -> mi.Bool:
    """Does the view land where there are camera samples, or at most `margin` [px] off, between the clipping planes?"""
    lower, upper = frame.window
    x, y = view.p.x, view.p.y
    inside = (x >= lower[0] - margin) & (x < upper[0] + margin) & (y >= lower[1] - margin) & (y < upper[1] + margin)
    return view.valid & inside


def seen_by_sensor(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, view: View, hide_emitters: bool, active: mi.Bool
) -> mi.Bool:
    """Is nothing between the start of its viewing ray and `si`? Hidden emitters are transparent, and not seen.

    As camera rays see it, from which no height above the surface is left out: next to an outline, or below something
    thin, another point is hidden from that height. The inner wall of a ball or a tube, next to its outline, is as close
    behind the outer one as one likes: there, the ray ends a little off the wall, on the side that is seen.
    """
    cos = dr.maximum(dr.abs(dr.dot(si.n, view.ω)), LEAST_COSINE)
    height = start_height(si.p)
    two_walls = has_two_walls(si.shape)
    off = si.p - dr.mulsign(TOUCHES * height, dr.dot(si.n, view.ω)) * si.n - view.o
    ray = mi.Ray3f(view.o, dr.select(two_walls, dr.normalize(off), view.ω))
    ray.maxt = dr.select(two_walls, dr.norm(off), view.r - (TOUCHES * height + ROUNDING * view.r) / cos)
    if hide_emitters:
        active = active & (si.shape.emitter() == None)  # noqa: E711 (an array comparison)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    if hide_emitters:
        _, pi = see_through_emitters(scene, ray, pi)
    # What is met may be the surface itself: where a large face is, is rounded.
    itself = (pi.shape == si.shape) & (pi.prim_index == si.prim_index) & ~two_walls
    itself &= pi.t >= view.r * (1 - SHADOW_EPSILON) - height / cos
    return active & (~pi.is_valid() | itself)


def has_two_walls(shape: mi.ShapePtr) -> mi.Bool:
    """May a ray meet one primitive of the shape twice?"""
    kind = shape.shape_type()
    return (kind == mi.UInt32(mi.ShapeType.Sphere)) | (kind == mi.UInt32(mi.ShapeType.Cylinder))
