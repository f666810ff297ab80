"""Rims of cylinders and disks that lie in faces of other shapes, as of cups on tables and pillars on floors, and are
moved off these, or into them: as for meshes (`contact_motion.py`), the image has a kink there.

Rims stand for polygons, and disks for fans of triangles about them. Needs the direction of the derivative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ad import tangents
from ..core.compat import faces_buffer, mesh_positions, positions_buffer
from ..plan.job import Job
from ..scene.facts import ShapeFacts
from .contact_motion import PARTING, off_faces, say_parted
from .intersections import TriangleMesh, overlap
from .overlaps import box_of
from .topology import INVALID, WELD_TOLERANCE
from .touching import Resting, parts_in_faces

#: Corners of the polygon that a rim stands for.
CORNERS = 48

#: Heights at which the rims of a plugin are, in its own space.
RIMS = {"disk": (0.0,), "cylinder": (0.0, 1.0)}


@dataclass(frozen=True)
class _Body:
    """A shape with rims, or with faces in which rims may lie."""

    shape: mi.Shape
    plugin: str
    moves: bool

    @cached_property
    def rims(self) -> TriangleMesh:
        """Edges alone; of a mesh none."""
        heights = RIMS.get(self.plugin, ())
        points = [_in_world(self.shape, _circle(height)) for height in heights]
        corner = np.arange(CORNERS)
        ring = np.stack([corner, (corner + 1) % CORNERS], 1)
        edges = [ring + k * CORNERS for k in range(len(heights))]
        edges = np.concatenate([np.zeros((0, 2), int), *edges])
        positions = np.concatenate([np.zeros((0, 3)), *points])
        return TriangleMesh(positions, np.zeros((0, 3), int), edges, np.full_like(edges, INVALID))

    @cached_property
    def faces(self) -> TriangleMesh:
        """Faces alone; of a cylinder none."""
        none = np.zeros((0, 2), int)
        if self.shape.is_mesh():
            positions = np.array(dr.detach(positions_buffer(self.shape))).reshape(-1, 3)
            return TriangleMesh(positions, np.array(faces_buffer(self.shape)).reshape(-1, 3), none, none)
        if self.plugin != "disk":
            return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int), none, none)
        corner = np.arange(CORNERS)
        fan = np.stack([corner, (corner + 1) % CORNERS, np.full(CORNERS, CORNERS)], 1)
        return TriangleMesh(_in_world(self.shape, _fan()), fan, none, none)

    @cached_property
    def speed_of_rims(self) -> np.ndarray:
        """(V, 3) of the corners of `rims`."""
        points = [_circle(height) for height in RIMS.get(self.plugin, ())]
        return np.concatenate([np.zeros((0, 3)), *(_speed(self.shape, x) for x in points)])

    @cached_property
    def speed_of_faces(self) -> np.ndarray:
        """(V, 3) of the corners of `faces`."""
        if not self.shape.is_mesh():
            return _speed(self.shape, _fan())
        with dr.resume_grad():
            found = tangents(mesh_positions(self.shape))
        return np.array(mi.Vector3f(found), float).T


def warn_about_lifted_rims(job: Job, shapes: Sequence[mi.Shape], chosen: Sequence[ShapeFacts]) -> None:
    """Name shapes of which one stands on the other by a rim, and leaves it, each pair once. `chosen`: of `shapes`."""
    if job.call.mode != "forward" or not any(s.plugin in RIMS and not s.is_mesh for s in chosen):
        return
    bodies = [_Body(shapes[s.index], "mesh" if s.is_mesh else s.plugin, s.moves) for s in chosen]
    boxes = [box_of(body.shape) for body in bodies]
    for i, j in _near([body.plugin in RIMS for body in bodies], boxes):
        own, other = bodies[i], bodies[j]
        if (own.moves or other.moves) and _leaves(own, other):
            say_parted(job, own.shape, other.shape)


def _near(has_rims: list[bool], boxes: list[np.ndarray]) -> Iterator[tuple[int, int]]:
    """Pairs of a shape with rims and another one whose boxes touch."""
    for i in np.flatnonzero(has_rims):
        for j in range(len(boxes)):
            if i != j and overlap(boxes[i], boxes[j], _slack(boxes[i], boxes[j])) is not None:
                yield i, j


def _slack(*boxes: np.ndarray) -> float:
    """Distance that counts as none."""
    return WELD_TOLERANCE * max(np.linalg.norm(box[1] - box[0]) + np.abs(box).max() for box in boxes)


def _leaves(own: _Body, other: _Body) -> bool:
    """Do rims of `own` lie in faces of `other`, and move off these?"""
    if not len(own.rims.edges) or not len(other.faces.faces):
        return False
    ends = own.rims.positions[own.rims.edges]
    slack = _slack(own.rims.box, other.faces.box)
    found = parts_in_faces(ends, other.faces.positions[other.faces.faces].astype(float), slack)
    if not len(found.edge):
        return False
    v, v_other = own.speed_of_rims, other.speed_of_faces
    fastest = max(np.linalg.norm(x, axis=1).max() for x in (v, v_other))
    at = Resting(found.edge, found.face, found.on_edge)
    return bool(off_faces(own.rims, v, other.faces, v_other, at).max() > PARTING * fastest)


def _circle(height: float) -> np.ndarray:
    """(CORNERS, 3) on the rim, in the shape's own space."""
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    return np.stack([np.cos(angle), np.sin(angle), np.full(CORNERS, height)], 1)


def _fan() -> np.ndarray:
    """(CORNERS + 1, 3): a polygon about a disk, and its centre."""
    around = _circle(0.0) / np.cos(np.pi / CORNERS)
    return np.concatenate([around, np.zeros((1, 3))])


def _in_world(shape: mi.Shape, x: np.ndarray) -> np.ndarray:
    return np.array(dr.detach(_attached(shape, x)), float).T


def _speed(shape: mi.Shape, x: np.ndarray) -> np.ndarray:
    """(N, 3) of points that move with the shape."""
    with dr.resume_grad():
        found = tangents(_attached(shape, x))
    return np.array(mi.Vector3f(found), float).T


def _attached(shape: mi.Shape, x: np.ndarray) -> mi.Point3f:
    return mi.traverse(shape)["to_world"] @ mi.Point3f(x.T.astype(np.float32))
