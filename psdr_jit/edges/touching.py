"""Where edges of two meshes run along each other, or in faces of the other: parts of edges, by parameters. Pure NumPy.

Two edges at one place are one discontinuity, also where they share a part of their length only (a small box on a large
one, flush in front). An edge in a face of another shape is a contact, which a motion may open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .intersections import unit_normals
from .near_pairs import near_pairs

#: Shortest common part of two edges, or of an edge and a face, in units of the distance that counts as touching.
LEAST = 20.0

#: Pairs that are looked at for one pair of meshes; of what touches in more places the rest is not looked for.
MAX_TESTS = 1 << 22


@dataclass(frozen=True)
class Shared:
    """Common parts of edges: N rows, each a stretch [start, end] of the parameter of both edges."""

    a: np.ndarray  # (N,) indices of edges
    b: np.ndarray
    on_a: np.ndarray  # (N, 2), ascending in the direction of a
    on_b: np.ndarray  # (N, 2), of the same two points


@dataclass(frozen=True)
class Resting:
    """Stretches of edges that lie in faces: N rows."""

    edge: np.ndarray  # (N,)
    face: np.ndarray
    on_edge: np.ndarray  # (N, 2)


def shared_parts(a: np.ndarray, b: np.ndarray, tol: float) -> Shared:
    """Common parts of segments `a` (N, 2, 3) and `b` (M, 2, 3), where these are one and the same included."""
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2)))]
    for i, j in _near(a, b, tol):
        p, q = a[i], b[j]
        on_a, on_b = _along(p, q), _along(q, p)
        length_a, length_b = _length(p), _length(q)
        off = np.where(length_a >= length_b, _off_line(p, q), _off_line(q, p))
        clipped = np.clip(np.sort(on_a, axis=1), 0, 1)
        common = (clipped[:, 1] - clipped[:, 0]) * length_a
        there = (off <= tol) & (common > LEAST * tol)
        turned = (on_a[:, 0] > on_a[:, 1])[:, None]  # b runs the other way: its smaller parameter is a's larger one
        of_b = np.clip(np.where(turned, np.sort(on_b, axis=1)[:, ::-1], np.sort(on_b, axis=1)), 0, 1)
        found.append((i[there], j[there], clipped[there], of_b[there]))
    return Shared(*(np.concatenate(column) for column in zip(*found, strict=True)))


def parts_in_faces(edges: np.ndarray, corners: np.ndarray, tol: float) -> Resting:
    """Stretches of segments (N, 2, 3) that lie in triangles (M, 3, 3), their borders included."""
    n = unit_normals(corners)
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))]
    for i, f in _near(edges, corners, tol):
        height = np.abs(_dot(edges[i] - corners[f][:, :1], n[f][:, None])).max(1)
        i, f = i[height <= tol], f[height <= tol]
        on = _inside(edges[i], corners[f], n[f], tol)
        there = (on[:, 1] - on[:, 0]) * _length(edges[i]) > LEAST * tol
        found.append((i[there], f[there], on[there]))
    return Resting(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _near(a: np.ndarray, b: np.ndarray, tol: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of `a` and `b` whose boxes touch."""
    tests = 0
    for i, j in near_pairs(a.min(1) - tol, a.max(1) + tol, b.min(1) - tol, b.max(1) + tol):
        yield i, j
        tests += len(i)
        if tests > MAX_TESTS:
            return


def _inside(edges: np.ndarray, corners: np.ndarray, n: np.ndarray, tol: float) -> np.ndarray:
    """(N, 2) stretch of each segment on the inner side of all three sides of its triangle; start > end if none is."""
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        inward = np.cross(n, end - start)
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-300)
        h0, h1 = (_dot(edges[:, end_of] - start, inward) + tol for end_of in (0, 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = h0 / (h0 - h1)
        low = np.where((h0 < 0) & (h1 >= 0), np.maximum(low, cut), low)
        high = np.where((h0 >= 0) & (h1 < 0), np.minimum(high, cut), high)
        high = np.where((h0 < 0) & (h1 < 0), -1, high)
    return np.stack([low, high], axis=1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1)


def _length(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p[:, 1] - p[:, 0], axis=1)


def _along(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, 2) parameters on the lines of `p` of the ends of `q`."""
    d = p[:, 1] - p[:, 0]
    return _dot(q - p[:, :1], d[:, None]) / np.maximum(_dot(d, d), 1e-300)[:, None]


def _off_line(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N,) distance from the line of `p` of the farther end of `q`."""
    return np.linalg.norm(q - p[:, :1] - _along(p, q)[..., None] * (p[:, 1] - p[:, 0])[:, None], axis=2).max(1)
