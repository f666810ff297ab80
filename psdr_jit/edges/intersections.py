"""Where two surfaces cut into each other: segments between triangles, arcs between a ball and triangles. Pure NumPy.

The curve along which two shapes intersect is seen like an edge, but no mesh edge lies on it. Between two triangles it
is a segment whose ends are the points where an edge of one pierces the other [Möller 1997].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .near_pairs import near_pairs
from .topology import INVALID

#: Pairs of an edge and a triangle that are tested at once (memory), up to which all are tested, and in all (time) for
#: one pair of meshes.
CHUNK = 1 << 18
ALL_PAIRS = 1 << 18
MAX_TESTS = 1 << 26

#: Parts in which `near_pairs` may hand out those of a mesh with itself, about three seconds: meshes of long slivers,
#: whose boxes all overlap, are left out.
MAX_PARTS_WITHIN = 12

#: Surfaces closer than this, relative to their coordinates, rest on each other: their own edges are what is seen.
RESTING = 1e-5

#: Sine of the angle between two faces below which they count as parallel.
PARALLEL = 1e-3


class TooManyPairs(Exception):
    """Two meshes whose overlap is too dense for testing every edge against every triangle."""


@dataclass(frozen=True)
class TriangleMesh:
    """Positions and topology of one mesh, as NumPy arrays."""

    positions: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    edges: np.ndarray  # (E, 2) vertices
    edge_faces: np.ndarray  # (E, 2), INVALID where there is none

    @cached_property
    def box(self) -> np.ndarray:
        return np.array([[column.min(), column.max()] for column in self.positions.T]).T

    def corners(self, face: np.ndarray) -> np.ndarray:
        """Of faces with these numbers (N,), in double precision (N, 3, 3)."""
        return self.positions[self.faces[face]].astype(float)


def unit_normals(corners: np.ndarray) -> np.ndarray:
    """Of triangles (N, 3, 3), by their winding; 0 where they have no area."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)


@dataclass(frozen=True)
class Segments:
    """Common segments of triangle pairs: N rows."""

    face_a: np.ndarray  # (N,)
    face_b: np.ndarray
    start: np.ndarray  # (N, 3)
    end: np.ndarray


def tolerance(*boxes: np.ndarray, relative: float = RESTING) -> float:
    """Absolute distance below which surfaces within these boxes count as touching."""
    return relative * max(np.abs(box).max() + np.linalg.norm(box[1] - box[0]) for box in boxes)


def overlap(box_a: np.ndarray, box_b: np.ndarray, margin: float) -> np.ndarray | None:
    """The common part of two boxes (2, 3), widened; None if they are apart."""
    lower, upper = np.maximum(box_a[0], box_b[0]) - margin, np.minimum(box_a[1], box_b[1]) + margin
    return None if np.any(lower > upper) else np.stack([lower, upper])


def mesh_mesh(a: TriangleMesh, b: TriangleMesh) -> Segments:
    """Segments along which faces of two meshes cross. Raises `TooManyPairs` where the overlap is too dense."""
    tol = tolerance(a.box, b.box)
    common = overlap(a.box, b.box, tol)
    hits = []
    if common is not None:
        for own, other, swap in ((a, b, False), (b, a, True)):
            edge, face, x = _pierced(own, other, common, tol)
            for side in own.edge_faces[edge].T:
                has = side != INVALID
                pair = (face[has], side[has]) if swap else (side[has], face[has])
                hits.append((*pair, x[has]))
    if not hits:
        return _segments(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), len(b.faces))
    face_a, face_b, x = (np.concatenate(column) for column in zip(*hits, strict=True))
    return _segments(face_a.astype(np.int64), face_b.astype(np.int64), x, len(b.faces))


def mesh_itself(a: TriangleMesh) -> Segments:
    """Segments along which faces of one mesh cross each other. Raises `TooManyPairs` where it is too dense.

    Of two faces that share a corner, at most one edge pierces the other face: the segment begins in the corner.
    """
    ends, corners = a.positions[a.edges].astype(float), a.positions[a.faces].astype(float)
    edge, face, x = _near_crossings(ends, corners, tolerance(a.box), MAX_PARTS_WITHIN)
    hits = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))]
    for side in a.edge_faces[edge].T.astype(np.int64):
        has = side != INVALID
        hits.append((np.minimum(side, face)[has], np.maximum(side, face)[has], x[has]))
    one, other, x = (np.concatenate(column) for column in zip(*hits, strict=True))
    apart = np.linalg.norm(corners[one][:, :, None] - corners[other][:, None], axis=3)
    pair, k, _ = np.nonzero(apart <= tolerance(a.box))
    one, other = np.append(one, one[pair]), np.append(other, other[pair])
    return _segments(one, other, np.concatenate([x, corners[one[pair], k]]), len(a.faces))


def in_box(positions: np.ndarray, corners: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which of `corners` (N, k) have bounding boxes that overlap `box`? By the outcodes of the vertices."""
    code = np.zeros(len(positions), np.uint8)
    for axis in range(3):
        code |= (positions[:, axis] < box[0, axis]).astype(np.uint8) << (2 * axis)
        code |= (positions[:, axis] > box[1, axis]).astype(np.uint8) << (2 * axis + 1)
    return np.flatnonzero(np.bitwise_and.reduce(code[corners], axis=1) == 0)


def _pierced(own: TriangleMesh, other: TriangleMesh, box: np.ndarray, tol: float):
    """Edges of `own` through faces of `other`: `(edge, face, point)`."""
    edge, face = in_box(own.positions, own.edges, box), in_box(other.positions, other.faces, box)
    ends = own.positions[own.edges[edge]].astype(float)
    corners = other.positions[other.faces[face]].astype(float)
    if len(edge) * len(face) > ALL_PAIRS:
        e, f, x = _near_crossings(ends, corners, tol)
        return edge[e], face[f], x
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))]
    step = max(1, CHUNK // max(len(face), 1))
    for i in range(0, len(edge), step):
        e, f, x = _crossings(ends[i : i + step], corners, tol)
        found.append((edge[i + e], face[f], x))
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _crossings(ends: np.ndarray, corners: np.ndarray, tol: float):
    """All pairs (segment, triangle) that cross: `(segment, triangle, point)`. An end in the plane is no crossing."""
    n = unit_normals(corners)
    level = np.einsum("ij,ij->i", n, corners[:, 0])
    d0, d1 = (ends[:, k] @ n.T - level for k in (0, 1))
    e, f = np.nonzero((d0 * d1 < 0) & (np.minimum(np.abs(d0), np.abs(d1)) > tol))
    t = d0[e, f] / (d0[e, f] - d1[e, f])
    x = ends[e, 0] + t[:, None] * (ends[e, 1] - ends[e, 0])
    weights = barycentric(x, corners[f])
    inside = weights.min(1) >= -1e-9
    return e[inside], f[inside], x[inside]


def _near_crossings(ends: np.ndarray, corners: np.ndarray, tol: float, most_parts: int | None = None):
    """The same for many segments and triangles: only pairs whose boxes overlap are tested."""
    n = unit_normals(corners)
    level = np.einsum("ij,ij->i", n, corners[:, 0])
    found, tests = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))], 0
    for part, (e, f) in enumerate(near_pairs(ends.min(1), ends.max(1), corners.min(1), corners.max(1))):
        tests += len(e)
        if tests > MAX_TESTS or part == most_parts:
            raise TooManyPairs
        d0, d1 = (np.einsum("ij,ij->i", ends[e, k], n[f]) - level[f] for k in (0, 1))
        through = (d0 * d1 < 0) & (np.minimum(np.abs(d0), np.abs(d1)) > tol)
        e, f, d0, d1 = e[through], f[through], d0[through], d1[through]
        x = ends[e, 0] + (d0 / (d0 - d1))[:, None] * (ends[e, 1] - ends[e, 0])
        inside = barycentric(x, corners[f]).min(1) >= -1e-9
        found.append((e[inside], f[inside], x[inside]))
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def cross(a: np.ndarray, b: np.ndarray, tol: float) -> bool:
    """Does any of the triangles `a` (N, 3, 3) cross any of `b`? True where that would take too many tests."""
    sides = ((0, 1), (1, 2), (2, 0))
    try:
        for own, other in ((a, b), (b, a)):
            ends = np.concatenate([own[:, side] for side in sides])
            if len(_near_crossings(ends, other, tol)[0]):
                return True
    except TooManyPairs:
        return True
    return False


def barycentric(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N, 3) weights of the corners (N, 3, 3) in points of their planes."""
    u, v, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], x - corners[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    det = uu * vv - uv**2
    det = np.where(det > 0, det, np.inf)
    b1, b2 = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    return np.stack([1 - b1 - b2, b1, b2], axis=1)


def _segments(face_a: np.ndarray, face_b: np.ndarray, x: np.ndarray, stride: int) -> Segments:
    """Join the hits of each pair of faces: of more than two, the two farthest apart."""
    key = face_a * stride + face_b
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    two = first[count == 2]
    more = [_farthest(x, order[i : i + n]) for i, n in zip(first[count > 2], count[count > 2], strict=True)]
    pairs = np.concatenate([np.stack([order[two], order[two + 1]], 1), np.array(more, dtype=int).reshape(-1, 2)])
    long = np.linalg.norm(x[pairs[:, 1]] - x[pairs[:, 0]], axis=1) > 0
    i, j = pairs[long].T
    return Segments(face_a[i], face_b[i], x[i], x[j])


def _farthest(x: np.ndarray, rows: np.ndarray) -> tuple[int, int]:
    distance = np.linalg.norm(x[rows][:, None] - x[rows][None], axis=2)
    i, j = np.unravel_index(np.argmax(distance), distance.shape)
    return rows[i], rows[j]
