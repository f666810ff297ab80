"""Surfaces that clipping planes cut where the sensor sees them: along the cut the image steps, and no edge is there.

`near_clip` and `far_clip` are read by all sensors, and scenes of another scale than their defaults run into them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory
from ..core.sensor_frame import SensorFrame, sensor_frame
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts
from .sight_lines import GRID, first_hits, lines_of_sight


def warn_about_clipping(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Warn once where neighbouring camera rays meet the same shape before and behind a clipping plane."""
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
    eye, d, start, planes = lines_of_sight(scene, frame)
    found = []
    for name, plane, before in (("near_clip", planes[0], start), ("far_clip", planes[1], np.array(0.0))):
        shape, z = _met(scene, frame, eye - before * d, d)
        steps = [shape[:, 1:][_steps(shape, z < plane)], shape[1:][_steps(shape.T, (z < plane).T).T]]
        found += [(name, int(k)) for k in np.concatenate(steps)[:1]]
    return found


def _steps(shape: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(N, N - 1): do neighbours in a row show the same shape on different sides of the plane?"""
    return (shape[:, 1:] == shape[:, :-1]) & (shape[:, 1:] >= 0) & (before[:, 1:] != before[:, :-1])


def _met(scene: mi.Scene, frame: SensorFrame, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`(number of the shape in the scene, -1 for none; how far along the view)` of first hits, (GRID, GRID) each."""
    _, pi, shape = first_hits(scene, o, d)
    t = dr.select(pi.is_valid(), pi.t, 0)
    dr.eval(shape, t)
    to_local = np.linalg.inv(np.array(frame.to_world.matrix, float).reshape(4, 4))
    z = (o + np.array(t)[:, None] * d) @ to_local[2, :3] + to_local[2, 3]
    return (np.array(shape).astype(int) - 1).reshape(GRID, GRID), z.reshape(GRID, GRID)
