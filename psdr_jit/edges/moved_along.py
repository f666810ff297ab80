"""Did all points of a mesh move by one affine map? What cuts what, and where, then moves along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..core.memory import Memory, Slot, key_of
from .intersections import Segments, TriangleMesh
from .solids import Solid
from .topology import WELD_TOLERANCE, EdgeTopology

#: By two meshes, or one and itself: their topologies, their vertices, and the segments that were found for these.
SEGMENTS: Slot[dict[tuple[str | int, str | int], tuple[tuple[EdgeTopology, ...], np.ndarray, Segments]]] = Slot(dict)


@dataclass(frozen=True)
class AffineMap:
    """x ↦ (x − origin) · linear + image, for rows x (N, 3)."""

    origin: np.ndarray  # (3,)
    linear: np.ndarray  # (3, 3)
    image: np.ndarray  # (3,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return (x - self.origin) @ self.linear + self.image


def affine_map(before: np.ndarray, after: np.ndarray) -> AffineMap | None:
    """The map that takes points `before` (N, 3) to `after`, up to their rounding; None if there is none, or one that
    turns the points inside out or flattens them.

    Least squares about the centroids. Where the points lie in a plane, the map of least norm: across the plane it
    is not known, and nothing is there.
    """
    if before.shape != after.shape or len(before) < 4:
        return None
    before, after = before.astype(float), after.astype(float)
    origin, image = before.mean(0), after.mean(0)
    x, y = before - origin, after - image
    linear = np.linalg.lstsq(x.T @ x, x.T @ y, rcond=None)[0]
    size = max(np.abs(points).max() + np.ptp(points, axis=0).max() for points in (before, after))
    if not np.abs(x @ linear - y).max() <= WELD_TOLERANCE * size or np.linalg.det(linear) <= 0:
        return None
    return AffineMap(origin, linear, image)


def segments_moved_along(
    a: tuple[Solid, TriangleMesh], b: tuple[Solid, TriangleMesh], memory: Memory, look: Callable[[], Segments]
) -> Segments:
    """What was found for two `(solid, triangles)`, moved along if both have moved as one since; else what `look` finds.

    Raises what `look` raises.
    """
    (solid_a, mesh_a), (solid_b, mesh_b) = a, b
    key, topologies = (key_of(solid_a.mesh), key_of(solid_b.mesh)), (solid_a.topology, solid_b.topology)
    positions = np.concatenate([mesh_a.positions, mesh_b.positions]) if solid_a is not solid_b else mesh_a.positions
    known = memory[SEGMENTS].get(key)
    if known is not None and all(old is new for old, new in zip(known[0], topologies, strict=True)):
        along = affine_map(known[1], positions)
        if along is not None:
            return replace(known[2], start=along(known[2].start), end=along(known[2].end))
    found = look()
    memory[SEGMENTS][key] = (topologies, positions, found)
    return found
