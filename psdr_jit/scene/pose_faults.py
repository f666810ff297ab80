"""Poses that Mitsuba accepts and does not render as they say."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from .capabilities import GRID_SHAPES, SUN_SKIES
from .graph import SceneGraph, on_host_or_none

#: Relative difference of axis lengths (and cosine between axes) up to which a transform counts as uniform.
UNEVEN_SCALE = 1e-4

POSE = "to_world"

#: Shapes that rays meet in object space, while all else about them is put into world space.
MET_IN_OBJECT_SPACE = ("disk", "instance")

_ONE_WAY = (
    "has a to_world whose inverse Mitsuba has wrong, so that rays meet it elsewhere than it is; give rotations axes of "
    "length 1, or make it of its matrix alone"
)

_TURNED = (
    "is turned or mirrored by its to_world, which Mitsuba does not support: it shades it as if it was not; put it into "
    "a shapegroup and turn an instance of it"
)

_SEVERAL = (
    "has a to_world of several matrices, as a variable that Dr.Jit has widened makes it: assign one, by way of "
    "dr.opaque(mi.Float, 0), say"
)

#: Shape of one matrix.
ONE = (4, 4)


def shape_pose_fault(graph: SceneGraph, shape: mi.Shape, plugin: str) -> str:
    """What is wrong with the pose of a shape, and the way out; "" where nothing is, or while a function is frozen."""
    if plugin not in (*GRID_SHAPES, *MET_IN_OBJECT_SPACE, "sphere", "cylinder"):
        return ""
    matrix = _pose_of(graph, shape)
    if matrix is None:
        return ""
    if matrix.shape != ONE:
        return _SEVERAL
    if plugin in MET_IN_OBJECT_SPACE:
        return "" if _inverts(graph, shape, matrix) else _ONE_WAY
    if plugin in GRID_SHAPES:
        return _TURNED if _turns(matrix) else ""
    if stretches(matrix, plugin):
        return "is stretched or sheared, which Mitsuba renders as an unstretched one; scale it evenly, or use a mesh"
    if POSE in graph.enabled_of(shape) and np.linalg.det(matrix[:3, :3]) < 0:
        return (
            "is mirrored by its to_world, and Mitsuba turns its normals over in every params.update(): two images take "
            "turns; scale it by positive numbers, with flip_normals where it is lit from inside"
        )
    return ""


def sky_pose_fault(graph: SceneGraph, emitter: mi.Emitter, plugin: str) -> str:
    """The same of an environment map, or of a sky with a sun."""
    if plugin not in ("envmap", *SUN_SKIES):
        return ""
    matrix = _pose_of(graph, emitter)
    if matrix is None:
        return ""
    if matrix.shape != ONE:
        return _SEVERAL
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() <= UNEVEN_SCALE:
        return ""
    return (
        "has a to_world that does more than turn it, so that Mitsuba looks it up, or draws it, by directions that are "
        "not of length 1: image and derivative are off; scale nothing, and give rotations axes of length 1"
    )


def _pose_of(graph: SceneGraph, node: mi.Object) -> np.ndarray | None:
    """Of the shape `ONE`, unless there are several; None while a function is being frozen."""
    matrix = on_host_or_none(graph.value(node, POSE).matrix)
    return matrix if matrix is None or matrix.size != math.prod(ONE) else matrix.reshape(ONE)


def _inverts(graph: SceneGraph, shape: mi.Shape, matrix: np.ndarray) -> bool:
    """Does Mitsuba know how to undo this map? Of a rotation about an axis of another length than 1 it does not."""
    back = on_host_or_none(graph.value(shape, POSE).inverse_transpose)
    if back is None:
        return True
    return bool(np.abs(matrix[:3, :3] @ back.reshape(4, 4)[:3, :3].T - np.eye(3)).max() <= UNEVEN_SCALE)


def stretches(matrix: np.ndarray, plugin: str) -> bool:
    """Whether this object-to-world map (4, 4) makes an ellipsoid of a sphere, or an ellipse of a cylinder's circle."""
    if plugin not in ("sphere", "cylinder"):
        return False
    axes = matrix[:3, :3]
    length = np.linalg.norm(axes, axis=0)
    round_axes = length if plugin == "sphere" else length[:2]
    gram = (axes / np.maximum(length, np.finfo(np.float32).tiny)).T @ axes / length.max()
    sheared = np.abs(gram - np.diag(np.diag(gram))).max() > UNEVEN_SCALE
    return bool(sheared or np.ptp(round_axes) > UNEVEN_SCALE * round_axes.max())


def _turns(matrix: np.ndarray) -> bool:
    left, _, right = np.linalg.svd(matrix[:3, :3])
    return bool(np.abs(left @ right - np.eye(3)).max() > UNEVEN_SCALE)
