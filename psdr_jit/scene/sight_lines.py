"""A grid of lines of sight, for what is asked of a scene before it is rendered."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.sensor_frame import KINDS, SensorFrame
from ..core.surface_code import top_level
from ..core.upload import uploaded
from .registry import registry_values

GRID = 64  # camera rays along each side of the film

EVERY = 16  # calls: things move while parameters are optimised

#: Of an integrator: calls so far.
CALLS: Slot[int] = Slot(int)


def is_time(sensor: mi.Sensor, memory: Memory) -> bool:
    """Is this the first of `EVERY` calls, and can the sensor's lines of sight be drawn? Counts the calls."""
    memory[CALLS] += 1
    known = sensor.class_name() in KINDS and not dr.flag(dr.JitFlag.FreezingScope)
    return known and memory[CALLS] % EVERY == 1


def lines_of_sight(scene: mi.Scene, frame: SensorFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple]:
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


def first_hits(
    scene: mi.Scene, o: np.ndarray, d: np.ndarray
) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.UInt32]:
    """`(rays, what they meet, 1 + number of the shape in the scene, or 0)` of points and directions (N, 3)."""
    start, along = (kind(*(uploaded(mi.Float, axis) for axis in v.T))
                    for kind, v in ((mi.Point3f, o), (mi.Vector3f, d)))  # fmt: skip
    ray = mi.Ray3f(start, along)
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    numbers = registry_values(scene, {k: k + 1 for k in range(len(scene.shapes()))})
    return ray, pi, dr.gather(mi.UInt32, numbers, top_level(pi), pi.is_valid())
