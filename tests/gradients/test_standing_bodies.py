"""A box or a tube on a floor, in the length units of several scenes and from as low as cameras stand: at its foot it is
seen against the floor. The same thing sunk into the floor looks the same; its foot is an intersection curve then.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from fuzz.meshes import box
from helpers import forward, mesh_of
from variants import also

from psdr_jit.derivative.perturbation import perturb

SPP, SEEDS = 256, 4
MIRROR = 2.6  # its place along z, between the camera and the body [units]
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


def room(what: str, unit: float, elevation: float, foot: float, mirrored: bool = False) -> mi.Scene:
    """It stands on a floor that shines, of which nothing else is seen, directly or in a mirror."""
    angle = np.radians(elevation)
    origin = unit * np.array([0.1, 4 * np.sin(angle), 4 * np.cos(angle)])
    target, up = unit * np.array([0.05, 0.02, 0.3]), [0, 1, 0]
    there = mi.ScalarTransform4f().translate([0, 0, MIRROR * unit]).rotate(up, 180).scale(3 * unit)
    mirror = {"type": "rectangle", "to_world": there, "bsdf": {"type": "conductor", "material": "none"}}
    if mirrored:
        for x in (origin, target):
            x[2] = 2 * MIRROR * unit - x[2]
    pose = mi.ScalarTransform4f().look_at(list(origin), list(target), up)
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    flat = mi.ScalarTransform4f().rotate((1, 0, 0), -90).scale(6 * unit)
    return mi.load_dict({
        "type": "scene", "body": standing(what, unit, foot),
        "floor": {"type": "rectangle", "to_world": flat, "light": {"type": "area", "radiance": 1.0}},
        "sensor": {"type": "perspective", "fov": 8, "to_world": pose, "film": film},
        **({"mirror": mirror} if mirrored else {}),
    }, optimize=False)  # fmt: skip


def derivative(scene: mi.Scene, unit: float, param: str, direction: tuple[float, float, float]) -> np.ndarray:
    """Of the image, in units of the scene's size."""
    motion = perturb(scene, param, direction)
    return unit * forward(motion, {"type": "psdr_path", "max_depth": 2}, SEEDS, SPP).mean(0)


@pytest.mark.parametrize("elevation", [ELEVATIONS[0], *(also(e) for e in ELEVATIONS[1:])])
@pytest.mark.parametrize("unit", [also(0.5), also(1.0), 500.0])
@pytest.mark.parametrize("what", ["box", also("tube")])
def test_a_foot_is_seen_against_the_floor(llvm, what, unit, elevation):
    moved = ("sensor.to_world", (0.3, 1, 0))
    on_it, sunk = (derivative(room(what, unit, elevation, foot), unit, *moved) for foot in (0.0, -0.5))
    size = np.sqrt(np.mean(sunk**2))
    assert size > 0.1
    assert np.abs(on_it - sunk).max() < 0.02 * size


@pytest.mark.slow
@pytest.mark.parametrize("elevation", ELEVATIONS)
@pytest.mark.parametrize("what", ["box", "tube"])
def test_and_so_it_is_in_a_mirror(llvm, what, elevation):
    moved = ("body.vertex_positions" if what == "box" else "body.to_world", (1, 0, 0.5))
    on_it, sunk = (derivative(room(what, 1.0, elevation, foot, True), 1.0, *moved) for foot in (0.0, -0.5))
    size = np.sqrt(np.mean(sunk**2))
    assert size > 0.1
    assert np.abs(on_it - sunk).max() < 0.03 * size
