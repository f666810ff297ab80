"""Rims of cylinders and disks that lie in faces of other shapes, as of cups on tables and pillars on floors.

Where they are moved off these, or into them, the image has a kink, as for meshes (`contact_motion.py`), which needs
the direction of the derivative. Rims stand for polygons, and disks for fans of triangles about them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..plan.job import Job
from ..scene.facts import ShapeFacts
from .contact_motion import PARTING, off_faces, say_parted, velocities_of, vertex_velocities
from .intersections import TriangleMesh, tolerance
from .overlaps import box_of, touching_boxes
from .solids import corners_and_faces
from .topology import INVALID, WELD_TOLERANCE
from .touching import Resting, parts_in_faces

#: Corners of the polygon that a rim stands for.
CORNERS = 48

#: Heights at which the rims of a plugin are, in its own space.
RIMS = {"disk": (0.0,), "cylinder": (0.0, 1.0)}

#: Sides of such a polygon, by corners.
_RING = np.stack([np.arange(CORNERS), (np.arange(CORNERS) + 1) % CORNERS], 1)


@dataclass(frozen=True)
class Body:
    """A shape with rims, or with faces in which rims may lie."""

    shape: mi.Shape
    facts: ShapeFacts

    @property
    def plugin(self) -> str:
        return self.facts.plugin

    @property
    def moves(self) -> bool:
        return self.facts.moves

    @cached_property
    def rims(self) -> TriangleMesh:
        """Edges alone. Not of a mesh."""
        edges = np.concatenate([_RING + k * CORNERS for k in range(len(RIMS[self.plugin]))])
        positions = _in_world(self.shape, _circles(self.plugin))
        return TriangleMesh(positions, np.zeros((0, 3), int), edges, np.full_like(edges, INVALID))

    @cached_property
    def faces(self) -> TriangleMesh:
        """Faces alone; of a cylinder none."""
        none = np.zeros((0, 2), int)
        if self.shape.is_mesh():
            return TriangleMesh(*corners_and_faces(self.shape), none, none)
        if self.plugin != "disk":
            return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int), none, none)
        fan = np.concatenate([_RING, np.full((CORNERS, 1), CORNERS)], 1)
        return TriangleMesh(_in_world(self.shape, _fan()), fan, none, none)

    @cached_property
    def speed_of_rims(self) -> np.ndarray:
        """(V, 3) of the corners of `rims`."""
        return _speed(self.shape, _circles(self.plugin))

    @cached_property
    def speed_of_faces(self) -> np.ndarray:
        """(V, 3) of the corners of `faces`."""
        return vertex_velocities(self.shape) if self.shape.is_mesh() else _speed(self.shape, _fan())


def warn_about_lifted_rims(job: Job, shapes: Sequence[mi.Shape], chosen: Sequence[ShapeFacts]) -> None:
    """Name shapes of which one stands on the other by a rim, and leaves it, each pair once. `chosen`: of `shapes`."""
    if job.call.mode != "forward":
        return
    for a, b in _neighbours(shapes, chosen):
        if (a.moves or b.moves) and (_leaves(a, b) or _leaves(b, a)):
            say_parted(job, a.shape, b.shape)


def standing(shapes: Sequence[mi.Shape], chosen: Sequence[ShapeFacts]) -> list[tuple[Body, Body]]:
    """Cylinders, and what they stand on or what stands on them. `chosen`: of `shapes`."""
    pairs = ((own, other) for a, b in _neighbours(shapes, chosen) for own, other in ((a, b), (b, a)))
    return [(own, other) for own, other in pairs if own.plugin == "cylinder" and len(_resting(own, other).edge)]


def _neighbours(shapes: Sequence[mi.Shape], chosen: Sequence[ShapeFacts]) -> Iterator[tuple[Body, Body]]:
    """Those whose boxes touch, if there are rims at all."""
    if any(s.plugin in RIMS for s in chosen):
        bodies = [Body(shapes[s.index], s) for s in chosen]
        for i, j in touching_boxes([box_of(body.shape) for body in bodies]):
            yield bodies[i], bodies[j]


def _resting(own: Body, other: Body) -> Resting:
    """Rims of `own` in faces of `other`."""
    if own.plugin not in RIMS or not len(other.faces.faces):
        return Resting(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    ends = own.rims.positions[own.rims.edges]
    slack = tolerance(own.rims.box, other.faces.box, relative=WELD_TOLERANCE)
    return parts_in_faces(ends, other.faces.positions[other.faces.faces].astype(float), slack)


def _leaves(own: Body, other: Body) -> bool:
    """Do rims of `own` lie in faces of `other`, and move off these?"""
    found = _resting(own, other)
    if not len(found.edge):
        return False
    v, v_other = own.speed_of_rims, other.speed_of_faces
    fastest = max(np.linalg.norm(x, axis=1).max() for x in (v, v_other))
    return bool(off_faces(own.rims, v, other.faces, v_other, found).max() > PARTING * fastest)


def _circle(height: float) -> np.ndarray:
    """(CORNERS, 3) on the rim, in the shape's own space."""
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    return np.stack([np.cos(angle), np.sin(angle), np.full(CORNERS, height)], 1)


def _circles(plugin: str) -> np.ndarray:
    """(R · CORNERS, 3) on all R rims."""
    return np.concatenate([_circle(height) for height in RIMS[plugin]])


def _fan() -> np.ndarray:
    """(CORNERS + 1, 3): a polygon about a disk, and its centre."""
    around = _circle(0.0) / np.cos(np.pi / CORNERS)
    return np.concatenate([around, np.zeros((1, 3))])


def _in_world(shape: mi.Shape, x: np.ndarray) -> np.ndarray:
    return np.array(dr.detach(_attached(shape, x)), float).T


def _speed(shape: mi.Shape, x: np.ndarray) -> np.ndarray:
    """(N, 3) of points that move with the shape."""
    return velocities_of(lambda: _attached(shape, x))


def _attached(shape: mi.Shape, x: np.ndarray) -> mi.Point3f:
    return mi.traverse(shape)["to_world"] @ mi.Point3f(x.T.astype(np.float32))
