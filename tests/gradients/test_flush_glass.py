"""Smooth glass that stands exactly on a surface: what is seen through it is rounding, which is said."""

from __future__ import annotations

import warnings

import mitsuba as mi
import pytest
from variants import also

from psdr_jit.derivative.perturbation import perturb

SIDE = 0.6


def warned(lift: float, bsdf: dict) -> list[str]:
    """What is said of a cube that stands so high above a floor."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "luminance"}
    look = T().look_at(origin=[1.2, 1.5, 2.4], target=[0, 0.2, 0], up=[0, 1, 0])
    cube = T().translate([0.1, SIDE / 2 + lift, 0]).rotate([0, 1, 0], 27).scale(SIDE / 2)
    scene = mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2)},
        "cube": {"type": "cube", "to_world": cube, "bsdf": bsdf},
        "lamp": {"type": "point", "position": [1, 3, 1], "intensity": 5.0},
    }, optimize=False)  # fmt: skip
    motion = perturb(scene, "camera.to_world", (1, 0, 0))
    motion.attach()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mi.load_dict({"type": "psdr_path", "max_depth": 4}).render_forward(
            scene, motion.params, sensor=scene.sensors()[0], spp=1
        )
    return [str(w.message) for w in found]


@pytest.mark.parametrize("lift, bsdf, named", [
    (0.0, "dielectric", True),
    also(0.006, "dielectric", False),
    (-0.01, "dielectric", False),
    also(0.0, "diffuse", False),
    also(0.0, "plastic", False),
])  # fmt: skip
def test_glass_flush_with_a_floor_is_named(llvm, lift, bsdf, named):
    said = [text for text in warned(lift, {"type": bsdf}) if "smooth glass" in text]
    assert len(said) == named
    assert all("'cube'" in text and "'floor'" in text for text in said)
