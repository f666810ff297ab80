"""Does the sensor see a path vertex? What walks that connect their vertices to the sensor have in common."""

from __future__ import annotations

import mitsuba as mi

from ..core.sensor_frame import SensorFrame, View
from .rays import SHADOW_EPSILON, see_through_emitters


def on_film(frame: SensorFrame, view: View, margin: mi.Float | float = 0.0) -> mi.Bool:
    """Does the view land where there are camera samples, or at most `margin` [px] off, between the clipping planes?"""
    lower, upper = frame.window
    x, y = view.p.x, view.p.y
    inside = (x >= lower[0] - margin) & (x < upper[0] + margin) & (y >= lower[1] - margin) & (y < upper[1] + margin)
    return view.valid & inside


def seen_by_sensor(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, view: View, hide_emitters: bool, active: mi.Bool
) -> mi.Bool:
    """Is nothing between `si` and the start of its viewing ray? Hidden emitters are transparent, and not seen."""
    if not hide_emitters:
        return active & ~scene.ray_test(si.spawn_ray_to(view.o), active)
    active = active & (si.shape.emitter() == None)  # noqa: E711 (an array comparison)
    ray = mi.Ray3f(view.o, view.ω)
    ray.maxt = view.r * (1 - SHADOW_EPSILON)
    pi = scene.ray_intersect_preliminary(ray, active=active)
    _, pi = see_through_emitters(scene, ray, pi)
    return active & ~pi.is_valid()
