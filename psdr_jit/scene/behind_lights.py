"""Curved shapes behind lights that `hide_emitters` makes transparent.

Mitsuba 3.9 goes on behind a hidden light with another ray, and takes the distance along that for one along the first:
a `sphere`, `cylinder` or `disk`, whose points it finds by their distance, is then lit and shaded in the wrong place,
or black, in the image of every one of its integrators. Meshes are not concerned.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts


@dataclass(frozen=True)
class _Ball:
    """Around a shape."""

    name: str
    centre: np.ndarray
    radius: float


def warn_about_shapes_behind_lights(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Name curved shapes of which balls around them say that a hidden light may be in front, once each."""
    shapes = scene.shapes()
    known = [s for s in facts.shapes if s.index >= 0]
    lights = [_ball(shapes[s.index], s.name) for s in known if s.is_emitter]
    curved = [_ball(shapes[s.index], s.name) for s in known if not (s.is_emitter or s.is_mesh)]
    if not curved or not lights:
        return
    pose = dr.detach(sensor.world_transform()).matrix
    eye, ahead = (np.array([float(pose[i, j][0]) for i in range(3)]) for j in (3, 2))
    for shape in curved:
        for light in lights:
            if _in_front(light, shape, eye, ahead, sensor.class_name() == "OrthographicCamera"):
                warn_once(
                    f"the light '{light.name}', which hide_emitters makes transparent, may be in front of shape "
                    f"'{shape.name}': Mitsuba's image of curved shapes behind hidden lights is wrong, and the "
                    "derivative is that of the right one; replace the shape by a mesh, or move the light",
                    UnsupportedWarning,
                    memory,
                )
                break


def _ball(shape: mi.Shape, name: str) -> _Ball:
    sphere = shape.bbox().bounding_sphere()
    return _Ball(name, np.array(sphere.center, float).ravel(), float(sphere.radius))


def _in_front(light: _Ball, shape: _Ball, eye: np.ndarray, ahead: np.ndarray, parallel: bool) -> bool:
    """Does a line of sight to the ball around the shape pass the ball around the light before?"""
    a, b = light.centre - eye, shape.centre - eye
    if parallel:
        across = np.linalg.norm(np.cross(a - b, ahead)) / np.linalg.norm(ahead)
        return bool(across < light.radius + shape.radius and a @ ahead < b @ ahead + shape.radius)
    far_a, far_b = np.linalg.norm(a), np.linalg.norm(b)
    if far_a <= light.radius or far_b <= shape.radius:
        return True
    between = np.arccos(np.clip(a @ b / (far_a * far_b), -1, 1))
    seen = np.arcsin(light.radius / far_a) + np.arcsin(shape.radius / far_b)
    return bool(between < seen and far_a - light.radius < far_b + shape.radius)
