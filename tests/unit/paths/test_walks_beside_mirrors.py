"""Walks from beside the outline of a mirror have their random numbers in common behind it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.low_discrepancy import lane_sampler
from psdr_jit.paths.walk import NoSink, PathLimits, walk

LANES, DEPTH = 4096, 6

#: How far from the outline the rays pass, in radii.
BESIDE = 1e-5


def _scene() -> mi.Scene:
    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
    lamp = mi.ScalarTransform4f().translate([0, 2.9, 0]).rotate([1, 0, 0], 90).scale(0.4)
    return mi.load_dict(
        {
            "type": "scene",
            "room": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(3), "flip_normals": True, "bsdf": wall},
            "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "conductor", "material": "none"}},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 20.0}},
        }
    )


def _radiance(scene: mi.Scene, more: int, side: float, aligned: bool) -> np.ndarray:
    """Along rays that pass the outline of the ball at a random place, inside of it or outside."""
    lane = dr.arange(mi.UInt32, LANES)
    φ = 2 * dr.pi * (mi.Float(lane) + 0.5) / LANES
    o, r = mi.Point3f(0, 0, 2.5), 0.5 * (1 + side * BESIDE)
    slope = r / dr.sqrt(o.z**2 - r**2)  # of the cone that touches a ball of this radius
    ray = mi.Ray3f(o, dr.normalize(mi.Vector3f(slope * dr.cos(φ), slope * dr.sin(φ), -1)))
    limits = PathLimits(max_depth=DEPTH + more, rr_depth=100, aligned=aligned)
    pi = scene.ray_intersect_preliminary(ray)
    L, _, _ = walk(scene, lane_sampler(mi.UInt32(7), lane), ray, pi, limits, NoSink(), mi.Bool(True), mi.Bool(True))
    return np.array(L)


def test_the_outline_of_a_mirror_hardly_shows(llvm):
    scene = _scene()
    outside = _radiance(scene, 0, 1, True)

    def alike(aligned: bool) -> float:
        """Share of the rays that bring the same inside, with the mirror as one segment more."""
        inside = _radiance(scene, 1, -1, aligned)
        return np.mean(np.abs(inside - outside).max(0) < 0.01 * outside.max(0))

    assert alike(True) > 0.75 and alike(False) < 0.3
    assert np.isclose(outside.mean(), _radiance(scene, 0, 1, False).mean(), rtol=0.1)
