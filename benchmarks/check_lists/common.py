"""What the scenes of the lists share: views, lights, motions and what is asked of a case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

SIDE = 24  # [px]
MOVE, TURN = 0.001, 0.0007  # steps of differences [scene units, rad]: a hundredth of a pixel
ALONG, ABOUT = (0.6, 0.3, -0.5), (0.48, 0.6, 0.64)


@dataclass(frozen=True)
class Motion:
    """What moves, how, and the step of differences."""

    param: str
    eps: float
    direction: Any = None
    rotate: Any = None


@dataclass(frozen=True)
class Listed:
    """A scene and a motion in it, and how well it must be known."""

    of: str  # the list
    name: str
    scene: Callable[[], mi.Scene]
    motion: Motion
    tolerance: float = 0.02
    stderr: float = 0.0068
    method: str = "psdr_path"


def moved(param: str, direction: Any = ALONG, eps: float = MOVE) -> Motion:
    return Motion(param, eps, direction)


def turned(param: str, axis: Any = ABOUT) -> Motion:
    return Motion(param, TURN, rotate=axis)


def T() -> Any:
    return mi.ScalarTransform4f()


def unit(*axis: float) -> list[float]:
    """Mitsuba takes axes as they are: one of another length stretches what it turns."""
    return list(np.array(axis) / np.linalg.norm(axis))


def view(origin: tuple, target: tuple = (0, 0, 0), fov: float = 34) -> dict:
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "gaussian"}, "pixel_format": "rgb"}
    pose = T().look_at(origin=list(origin), target=list(target), up=[0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": pose, "film": film}


def scene_of(depth: int, camera: dict, integrator: str = "path", **parts: Any) -> mi.Scene:
    path = {"type": integrator, "max_depth": depth, "rr_depth": 1000}
    return mi.load_dict({"type": "scene", "integrator": path, "camera": camera, **parts}, optimize=False)


def ground(height: float, size: float = 3, **bsdf: Any) -> dict:
    pose = T().translate([0, height, 0]).rotate(unit(1, 0, 0), -90).scale(size)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf or {"type": "diffuse"}}


def lamp(origin: tuple, size: float, radiance: float) -> dict:
    pose = T().look_at(origin=list(origin), target=[0, 0, 0], up=[0.1, 1, 0.2]).scale(size)
    return glowing(pose, radiance)


def glowing(pose: Any, radiance: float) -> dict:
    return {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": radiance},
            "bsdf": {"type": "diffuse", "reflectance": 0}}  # fmt: skip


def sky(image: np.ndarray, **settings: Any) -> dict:
    """An environment map of an array of shape (height, width, 3), whose last column is its first."""
    return {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(image, np.float32)), **settings}


LAMP = ((1.9, 3.2, 2.3), 0.5, 18)  # place, half of its side, radiance
POINT = {"type": "point", "position": [1.9, 3.2, 2.3], "intensity": 20.0}


def checkered() -> dict:
    return {"type": "checkerboard", "color0": 0.15, "color1": 0.8, "to_uv": T().scale([4, 3, 1])}
