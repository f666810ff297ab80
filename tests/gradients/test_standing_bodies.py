"""A box or a tube on a floor, in the length units of several scenes and from as low as cameras stand: at its foot it is
seen against the floor. The same thing sunk into the floor looks the same; its foot is an intersection curve then.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from fuzz.meshes import box
from helpers import forward, mesh_of

from psdr_jit.derivative.perturbation import perturb

SPP, SEEDS = 256, 4
ELEVATIONS = (40.0, 8.0, 2.0)  # of the camera [degrees]


def standing(what: str, unit: float, foot: float) -> object:
    """A black thing whose lower side is at the height `foot`."""
    black = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
    if what == "tube":
        ends = {"p0": [0, unit * foot, 0], "p1": [0, unit, 0], "radius": 0.6 * unit}
        return {"type": "cylinder", **ends, "bsdf": {"type": "twosided", "bsdf": black}}
    points, faces = box(1)
    turned = points @ np.array(mi.ScalarTransform4f().rotate((0, 1, 0), 25).matrix)[:3, :3].T * (0.5, 1, 0.5)
    turned[:, 1] = np.where(points[:, 1] > 0, 1.0, foot)
    return mesh_of(unit * turned, faces, bsdf=black)


def room(what: str, unit: float, elevation: float, foot: float) -> mi.Scene:
    """It stands on a floor that shines, of which nothing else is seen."""
    angle = np.radians(elevation)
    origin = unit * np.array([0.1, 4 * np.sin(angle), 4 * np.cos(angle)])
    target, up = unit * np.array([0.05, 0.02, 0.3]), [0, 1, 0]
    pose = mi.ScalarTransform4f().look_at(list(origin), list(target), up)
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    flat = mi.ScalarTransform4f().rotate((1, 0, 0), -90).scale(6 * unit)
    return mi.load_dict({
        "type": "scene", "body": standing(what, unit, foot),
        "floor": {"type": "rectangle", "to_world": flat, "light": {"type": "area", "radiance": 1.0}},
        "sensor": {"type": "perspective", "fov": 8, "to_world": pose, "film": film},
    }, optimize=False)  # fmt: skip


def derivative(scene: mi.Scene, unit: float) -> np.ndarray:
    """Of the image, in units of the scene's size, as the camera moves aside and up."""
    motion = perturb(scene, "sensor.to_world", (0.3, 1, 0))
    return unit * forward(motion, {"type": "psdr_path", "max_depth": 2}, SEEDS, SPP).mean(0)


@pytest.mark.parametrize("elevation", ELEVATIONS)
@pytest.mark.parametrize("unit", [0.5, 1.0, 500.0])
@pytest.mark.parametrize("what", ["box", "tube"])
def test_a_foot_is_seen_against_the_floor(llvm, what, unit, elevation):
    on_it, sunk = (derivative(room(what, unit, elevation, foot), unit) for foot in (0.0, -0.5))
    size = np.sqrt(np.mean(sunk**2))
    assert size > 0.1
    assert np.abs(on_it - sunk).max() < 0.02 * size
