"""Faces whose three corners are in a row: without area, and met by rays that pass along them, at any distance.

Pure NumPy.
"""

from __future__ import annotations

import numpy as np


def is_sliver(positions: np.ndarray, welded: np.ndarray, tolerance: float) -> np.ndarray:
    """(F,) bool, faces with a height below `tolerance`."""
    a, b, c = (positions[welded[:, k]] for k in range(3))
    ab, ac, bc = (b - a).T, (c - a).T, (c - b).T
    x, y, z = ab
    u, v, w = ac
    double_area2 = (y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2
    ab2, ac2, bc2 = (sx * sx + sy * sy + sz * sz for sx, sy, sz in (ab, ac, bc))
    longest2 = np.maximum(np.maximum(ab2, ac2), bc2)
    return double_area2 <= tolerance**2 * longest2


def share_of_edges(positions: np.ndarray, slivers: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Length of `slivers` (S, 3) relative to that of all edges; each of these is two half-edges, from start to end."""
    sides = [np.linalg.norm(positions[slivers[:, k]] - positions[slivers[:, k - 1]], axis=1) for k in range(3)]
    edges = np.linalg.norm(positions[end] - positions[start], axis=1).sum() / 2
    return float(np.maximum.reduce(sides).sum() / max(edges, np.finfo(float).tiny))
