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
from ..core.upload import uploaded
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts
from .registry import registry_values

GRID = 64  # camera rays along each side of the film

EVERY = 16  # calls: things move while parameters are optimised

#: Of an integrator: calls so far.
CALLS: Slot[int] = Slot(int)


def warn_about_clipping(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Warn once where neighbouring camera rays meet the same shape before and behind a clipping plane."""
    memory[CALLS] += 1
    if memory[CALLS] % EVERY != 1 or sensor.class_name() not in KINDS or dr.flag(dr.JitFlag.FreezingScope):
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
    frame = sensor_frame(sensor)
    eye, d, start, planes = _lines_of_sight(scene, frame)
    found = []
    for name, plane, before in (("near_clip", planes[0], start), ("far_clip", planes[1], np.array(0.0))):
        shape, z = _met(scene, frame, eye - before * d, d)
        steps = [shape[:, 1:][_steps(shape, z < plane)], shape[1:][_steps(shape.T, (z < plane).T).T]]
        found += [(name, int(k)) for k in np.concatenate(steps)[:1]]
    return found


def _steps(shape: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(N, N - 1): do neighbours in a row show the same shape on different sides of the plane?"""
    return (shape[:, 1:] == shape[:, :-1]) & (shape[:, 1:] >= 0) & (before[:, 1:] != before[:, :-1])


def _lines_of_sight(scene: mi.Scene, frame: SensorFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple]:
    """`(points on the near plane, unit directions, way back from there to before all that a plane may hide, planes)`,
    (N, 3), (N, 3), (N, 1) and numbers, world space, through the middles of the cells of a grid on the film.

    Made on the host: kernels of the sensor differ with what of its pose is known when they are compiled.
    """
    read = (frame.corner, frame.extent, frame.near, frame.far)
    corner, extent, near, far = (np.array(v, float).ravel() for v in read)
    across = (np.arange(GRID) + 0.5) / GRID
    x, y = (np.ravel(v) for v in np.meshgrid(corner[0] + extent[0] * across, corner[1] + extent[1] * across))
    pose = np.array(frame.to_world.matrix, float).reshape(4, 4)
    parallel = frame.kind == "orthographic"
    scale = 1 if parallel else near[0]
    local = np.stack([scale * x, scale * y, np.full_like(x, near[0])], 1)
    eye = local @ pose[:3, :3].T + pose[:3, 3]
    d = np.tile(pose[:3, 2], (len(x), 1)) if parallel else eye - pose[:3, 3]  # of a thin lens, from its centre
    length = np.linalg.norm(d, axis=1, keepdims=True)
    sphere = scene.bbox().bounding_sphere()
    outside = np.linalg.norm(eye - np.array(sphere.center, float).ravel(), axis=1, keepdims=True) + float(sphere.radius)
    return eye, d / length, outside if parallel else length, (near[0], far[0])


def _met(scene: mi.Scene, frame: SensorFrame, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`(number of the shape in the scene, -1 for none; how far along the view)` of first hits, (GRID, GRID) each."""
    start, along = (kind(*(uploaded(mi.Float, axis) for axis in v.T))
                    for kind, v in ((mi.Point3f, o), (mi.Vector3f, d)))  # fmt: skip
    pi = scene.ray_intersect_preliminary(mi.Ray3f(start, along), coherent=True)
    numbers = registry_values(scene, {k: k + 1 for k in range(len(scene.shapes()))})
    shape = dr.gather(mi.UInt32, numbers, top_level(pi), pi.is_valid())
    t = dr.select(pi.is_valid(), pi.t, 0)
    dr.eval(shape, t)
    to_local = np.linalg.inv(np.array(frame.to_world.matrix, float).reshape(4, 4))
    z = (o + np.array(t)[:, None] * d) @ to_local[2, :3] + to_local[2, 3]
    return (np.array(shape).astype(int) - 1).reshape(GRID, GRID), z.reshape(GRID, GRID)
