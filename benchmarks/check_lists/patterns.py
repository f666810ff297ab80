"""Steps inside surfaces × motions, near and behind a bounce; pictures and cones that lights bring along."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks.check_lists.common import (
    LAMP,
    POINT,
    Listed,
    T,
    checkered,
    ground,
    lamp,
    moved,
    scene_of,
    turned,
    unit,
    view,
)

NAME = "patterns"


def texels(**transform: Any) -> dict:
    data = np.random.default_rng(4).random((5, 4, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest", **transform}


def texels_turned() -> dict:
    return texels(to_uv=T().translate([0.2, -0.3, 0]).rotate(unit(0, 0, 1), 27).scale([1.7, 2.1, 1]))


TEXTURES = {"checkerboard": checkered, "texels": texels, "turned texels": texels_turned}
#: Plugin, and the axis and angle by which it is turned.
CARRIERS = {
    "plane": ("rectangle", unit(1, 0.2, 0.1), -70),
    "sphere": ("sphere", unit(0.3, 1, 0.2), 40),
    "cylinder": ("cylinder", unit(1, 0.4, 0.1), 60),
}


def painted(texture: str, carrier: str) -> dict:
    plugin, axis, angle = CARRIERS[carrier]
    bsdf = {"type": "twosided", "of": {"type": "diffuse", "reflectance": TEXTURES[texture]()}}
    return {"type": plugin, "to_world": T().rotate(axis, angle).scale(0.8), "bsdf": bsdf}


def pattern_scene(texture: str, carrier: str) -> mi.Scene:
    return scene_of(2, view((0.7, 1.9, 4.1), (0.05, 0.1, 0), 30), thing=painted(texture, carrier), point=POINT)


def bounced_scene(texture: str, carrier: str) -> mi.Scene:
    """The thing is out of view: a glossy wall shows it."""
    wall = {"type": "rectangle", "to_world": T().translate([0.1, 0, -1.6]).scale(1.5),
            "bsdf": {"type": "roughconductor", "alpha": 0.15}}  # fmt: skip
    camera = view((0.4, 0.5, 1.9), (0.1, 0.3, -1.6), 46)
    return scene_of(3, camera, thing=painted(texture, carrier), wall=wall, lamp=lamp(*LAMP))


def cast_scene(light: dict) -> mi.Scene:
    """A step that a light throws onto a floor."""
    pose = T().look_at(origin=[0.4, 2.3, 0.7], target=[0.1, -0.6, -0.1], up=[0.2, 0, 1])
    light = light | {"to_world": pose}
    return scene_of(2, view((0.7, 2.4, 3.6), (0.05, -0.5, 0), 40), lamp=light, floor=ground(-0.6))


def projector() -> mi.Scene:
    return cast_scene({"type": "projector", "fov": 27, "irradiance": texels(), "scale": 6.0})


def hard_spot() -> mi.Scene:
    return cast_scene({"type": "spot", "cutoff_angle": 14, "beam_width": 14, "intensity": 20.0})


def patterns() -> Iterator[Listed]:
    motions = {"moved": moved("thing.to_world"), "turned": turned("thing.to_world"), "camera": moved("camera.to_world")}
    for scene, where in ((pattern_scene, ""), (bounced_scene, " behind a bounce")):
        for carrier in CARRIERS:
            for texture in TEXTURES:
                for how, motion in motions.items():
                    name = f"{texture} on a {carrier}{where}, {how}"
                    yield Listed(NAME, name, partial(scene, texture, carrier), motion)
    for name, scene in (("projector", projector), ("hard spot", hard_spot)):
        for how, motion in (("moved", moved("lamp.to_world")), ("turned", turned("lamp.to_world"))):
            yield Listed(NAME, f"{name}, {how}", scene, motion)
