"""Which points of surfaces have another surface close by: corners, contacts, narrow gaps.

The *mixed* form of the path integral chooses by it what the vertex after x does, see `interior/material.py`. That is
unbiased for any function of x and of the side on which the path goes on, as long as all terms use the same one. Here
a few short rays tell, most of them low above the surface, where corners are: directions and lengths depend on x alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, view_width
from ..scene.surfaces import Surfaces
from .surface_at import surface_at

#: Length of the rays, relative to the width of what the film shows at the distance of x.
REACH = 3e-3

#: Rays around the normal; one more goes along it.
AROUND = 6

#: Sine of their angle to the surface.
SLANT = 0.4


@dataclass(frozen=True)
class CloseBy:
    """Host object of a render call."""

    scene: mi.Scene
    frame: SensorFrame
    surfaces: Surfaces | None = None  # that Mitsuba does not evaluate

    def met_by(
        self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, ω: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Bool:
        """`has` of the surface that `ray` meets at `pi`; not where it escapes."""
        si = surface_at(self.surfaces, pi, ray, mi.RayFlags.Minimal, active)
        return self.has(si, ω, active & si.is_valid())

    @dr.syntax
    def has(self, si: mi.SurfaceInteraction3f, ω: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        """Does anything lie within reach of the surface point, on the side of the direction ω (world)? Detached."""
        n = dr.select(dr.dot(si.n, ω) < 0, -si.n, si.n)
        s, t = mi.coordinate_system(n)
        reach = REACH * view_width(self.frame, si.p)
        found = mi.Bool(False)
        k = mi.UInt32(0)
        looks = mi.Bool(active)
        while dr.hint(looks, label="psdr.close_by", exclude=[self, si]):
            sin_φ, cos_φ = dr.sincos(k * (dr.two_pi / AROUND))
            d = dr.select(k < AROUND, dr.sqrt(1 - SLANT**2) * (cos_φ * s + sin_φ * t) + SLANT * n, n)
            ray = si.spawn_ray(d)
            ray.maxt = reach
            found = self.scene.ray_test(ray, False, looks)
            k += 1
            looks &= ~found & (k <= AROUND)
        return found
