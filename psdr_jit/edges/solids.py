"""Meshes, balls and cylinders that may touch or cut into each other, and in which state they are."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, positions_buffer
from ..scene.poses import on_host
from .intersections import TriangleMesh
from .overlaps import box_of
from .parts import Part
from .round_cuts import Tube
from .topology import EdgeTopology


@dataclass(frozen=True)
class Solid:
    """A mesh of an edge set."""

    mesh: mi.Mesh
    index: int  # in the edge set
    moves: bool
    topology: EdgeTopology
    shell: mi.Float  # by edge of the topology
    parts: tuple[Part, ...] = ()  # its connected surfaces, if there are several


@dataclass(frozen=True)
class Ball:
    """An analytic sphere."""

    shape: mi.Shape
    moves: bool

    def place(self) -> tuple[np.ndarray, float]:
        """Centre and radius, on the host."""
        to_world = _matrix(self.shape)
        return to_world[:3, 3], float(np.linalg.norm(to_world[:3, 0]))


@dataclass(frozen=True)
class Drum:
    """An analytic cylinder."""

    shape: mi.Shape
    moves: bool

    def tube(self) -> Tube:
        """Its place, on the host."""
        columns = _matrix(self.shape)[:3].T
        height, radius = (np.linalg.norm(columns[k]) for k in (2, 0))
        return Tube(columns[3], columns[2] / height, height, radius)


@dataclass(frozen=True)
class State:
    """Changes when the shape does. The buffer is kept alive, so that its index identifies it."""

    key: tuple
    buffer: mi.Float | None


def state_of(item: Solid | Ball | Drum) -> State:
    if isinstance(item, Ball):
        return State((item.moves, *box_of(item.shape).ravel()), None)
    if isinstance(item, Drum):
        return State((item.moves, *_matrix(item.shape).ravel()), None)
    buffer = dr.detach(positions_buffer(item.mesh))
    return State((item.moves, item.index, buffer.index), buffer)


def _matrix(shape: mi.Shape) -> np.ndarray:
    return on_host(mi.traverse(shape)["to_world"])


def triangles(solid: Solid) -> TriangleMesh:
    """The mesh on the host: copies of its arrays, no kernel."""
    t = solid.topology
    return TriangleMesh(*corners_and_faces(solid.mesh), np.stack([t.v0, t.v1], 1), np.stack([t.f0, t.f1], 1))


def corners_and_faces(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Positions (V, 3) and faces (F, 3) on the host, detached."""
    positions = np.array(dr.detach(positions_buffer(mesh))).reshape(-1, 3)
    return positions, np.array(faces_buffer(mesh)).reshape(-1, 3)
