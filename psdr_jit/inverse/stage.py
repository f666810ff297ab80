"""What stands in a scene, as plain arrays, for viewers: meshes, boxes around other shapes, cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.sensor_frame import KINDS, sensor_frame


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3), faces (F, 3), normals (V, 3) if it is smooth. World space."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None


@dataclass(frozen=True)
class Box:
    """Bounding box of a shape that has no vertices."""

    centre: np.ndarray
    half: np.ndarray


@dataclass(frozen=True)
class Camera:
    """Pose (4, 4), local to world; it looks along +z, and film x and y run along −x and −y."""

    pose: np.ndarray
    size: tuple[int, int]  # width, height [px]
    intrinsics: np.ndarray | None  # (3, 3) in pixels; None where no pinhole describes it


def shapes(scene: mi.Scene) -> dict[str, mi.Shape]:
    """By a name of their own."""
    return {shape.id() or f"shape {k}": shape for k, shape in enumerate(scene.shapes())}


def standing(shape: mi.Shape) -> Mesh | Box:
    """A shape as it is now."""
    if not isinstance(shape, mi.Mesh):
        bbox = shape.bbox()
        return Box(*(np.array(dr.detach(v), dtype=float).ravel() for v in (bbox.center(), bbox.extents() / 2)))

    def columns(buffer: Any) -> np.ndarray:
        return np.array(dr.detach(buffer)).reshape(-1, 3)

    normals = columns(shape.vertex_normals_buffer()) if shape.has_vertex_normals() else None
    return Mesh(columns(shape.vertex_positions_buffer()), columns(shape.faces_buffer()), normals)


def camera(sensor: mi.Sensor) -> Camera:
    """A sensor as it is now. Of one without a pinhole, the pose only."""
    pose = np.array(dr.detach(sensor.world_transform().matrix), dtype=float).reshape(4, 4)
    width, height = (int(n) for n in sensor.film().crop_size())
    if KINDS.get(sensor.class_name()) not in ("perspective", "thinlens"):
        return Camera(pose, (width, height), None)
    frame = sensor_frame(sensor)
    corner, extent = (np.array(v, dtype=float).ravel() for v in (frame.corner, frame.extent))
    fx, fy = width / abs(extent[0]), height / abs(extent[1])
    cx, cy = -corner[0] / extent[0] * width, -corner[1] / extent[1] * height
    return Camera(pose, (width, height), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def bodies(problem: Any) -> dict[str, mi.Shape]:
    """Shapes of all scenes of a problem. Of several scenes, each name begins with that of its scene, as views' do."""
    return {part.label(name): shape for part in problem.parts for name, shape in shapes(part.scene).items()}


def moving(problem: Any) -> set[str]:
    """Names, as in `bodies`, of shapes that a variable acts on, and of views whose sensors one acts on."""
    found: set[str] = set()
    for k, part in enumerate(problem.parts):
        owners = [part.params.properties[variable.parameter][2] for variable in part.variables.values()]
        own = {part.label(name): shape for name, shape in shapes(part.scene).items()}
        own |= {view.name: view.sensor for view in problem.views if view.part == k}
        found |= {name for name, thing in own.items() if any(_same(thing, owner) for owner in owners)}
    return found


def _same(one: Any, other: Any) -> bool:
    """Mitsuba may wrap an object anew each time that it hands it over; ids are kept."""
    return one is other or (one.class_name() == other.class_name() and one.id() == other.id() != "")
