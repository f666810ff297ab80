"""Surfaces that clipping planes cut where the sensor sees them: along the cut the image steps, and no edge is there.

`near_clip` and `far_clip` are read by all sensors, and scenes of another scale than their defaults run into them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.sensor_frame import KINDS, SensorFrame, sensor_frame
from ..core.surface_code import top_level
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts
from .registry import registry_values

GRID = 64  # camera rays along each side of the film

#: Of an integrator: calls so far. It is looked at the calls 1, 2, 4, 8, ...
CALLS: Slot[list[int]] = Slot(lambda: [0])


def warn_about_clipping(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Warn once where neighbouring camera rays meet the same shape before and behind a clipping plane."""
    calls = memory[CALLS]
    calls[0] += 1
    if calls[0] & (calls[0] - 1) or sensor.class_name() not in KINDS or dr.flag(dr.JitFlag.FreezingScope):
        return
    for name, shape in _cut(scene, sensor):
        known = next((f"'{s.name}'" for s in facts.shapes if s.index == shape), "a shape")
        warn_once(
            f"the plane at {name} of sensor '{facts.sensor.name}' cuts {known} where it is seen: the image steps "
            f"there, and this part of the derivative is missing; set {name} so that it cuts nothing",
            UnsupportedWarning, memory,
        )  # fmt: skip


def _cut(scene: mi.Scene, sensor: mi.Sensor) -> list[tuple[str, int]]:
    """`(parameter, index of a shape)` of what is cut, each parameter once."""
    with dr.suspend_grad():
        frame = sensor_frame(sensor)
        i = dr.arange(mi.UInt32, GRID * GRID)
        film = (mi.Point2f(mi.Float(i % GRID), mi.Float(i // GRID)) + 0.5) / GRID
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, film, mi.Point2f(0.5))
        beyond = _met(scene, frame, mi.Ray3f(ray.o, ray.d))  # without its end: what lies behind far_clip as well
        whole = _met(scene, frame, mi.Ray3f(ray.o - _way_back(scene, frame, ray) * ray.d, ray.d))
    planes = (np.array(plane)[0] for plane in (frame.near, frame.far))
    found = []
    for name, (shape, z), plane in zip(("near_clip", "far_clip"), (whole, beyond), planes, strict=True):
        steps = [shape[:, 1:][_steps(shape, z < plane)], shape[1:][_steps(shape.T, (z < plane).T).T]]
        found += [(name, int(k)) for k in np.concatenate(steps)[:1]]
    return found


def _steps(shape: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(N, N - 1): do neighbours in a row show the same shape on different sides of the plane?"""
    return (shape[:, 1:] == shape[:, :-1]) & (shape[:, 1:] >= 0) & (before[:, 1:] != before[:, :-1])


def _way_back(scene: mi.Scene, frame: SensorFrame, ray: mi.Ray3f) -> mi.Float:
    """From the near plane to the pinhole (of a thin lens, its centre), or to before everything."""
    if frame.kind == "orthographic":
        sphere = scene.bbox().bounding_sphere()
        return dr.norm(ray.o - mi.Point3f(sphere.center)) + sphere.radius
    return frame.near / dr.dot(ray.d, dr.normalize(frame.to_world @ mi.Vector3f(0, 0, 1)))


def _met(scene: mi.Scene, frame: SensorFrame, ray: mi.Ray3f) -> tuple[np.ndarray, np.ndarray]:
    """`(number of the shape in the scene, -1 for none; how far along the view)` of first hits, (GRID, GRID) each."""
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    numbers = registry_values(scene, {k: k + 1 for k in range(len(scene.shapes()))})
    shape = np.array(dr.gather(mi.UInt32, numbers, top_level(pi), pi.is_valid())).astype(int) - 1
    z = np.array((frame.to_local @ ray(dr.select(pi.is_valid(), pi.t, 0))).z)
    return shape.reshape(GRID, GRID), z.reshape(GRID, GRID)
