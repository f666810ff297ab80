"""The surface of a grid of signed distances as triangles, to ask whether it cuts into another shape. On the host."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.grids import VALUES

#: Corners of the six tetrahedra of a cell, numbered x + 2y + 4z: all about its diagonal.
TETRAHEDRA = np.array([(0, a, b, 7) for a, b in ((1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1))])

#: By how many of a tetrahedron's corners lie inside, which are its first: on which of its sides triangles have corners.
TRIANGLES = {
    1: [((0, 1), (0, 2), (0, 3))],
    2: [((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2))],
    3: [((0, 3), (1, 3), (2, 3))],
}


def grid_triangles(shape: mi.Shape, to_world: np.ndarray) -> np.ndarray:
    """(F, 3, 3) in world space, where values between the corners of tetrahedra are linear."""
    f = np.array(dr.detach(mi.traverse(shape)[VALUES]), float)[..., 0].transpose(2, 1, 0)
    n = f.shape[0]
    steps = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    corners = np.stack([f[i : n - 1 + i, j : n - 1 + j, k : n - 1 + k] for i, j, k in steps])
    where = np.argwhere((corners.min(0) < 0) & (corners.max(0) >= 0))
    values = corners[(slice(None), *where.T)].T[:, TETRAHEDRA].reshape(-1, 4)
    points = (where[:, None] + np.array(steps))[:, TETRAHEDRA].reshape(-1, 4, 3) / (n - 1)
    points = points @ to_world[:3, :3].T + to_world[:3, 3]
    order = np.argsort(values >= 0, axis=1, kind="stable")  # those inside come first
    values, points = np.take_along_axis(values, order, 1), np.take_along_axis(points, order[..., None], 1)
    inside = (values < 0).sum(1)
    found = []
    for count, triangles in TRIANGLES.items():
        p, v = points[inside == count], values[inside == count]
        for sides in triangles:
            found.append(np.stack([_crossing(p, v, i, j) for i, j in sides], 1))
    return np.concatenate(found)


def _crossing(p: np.ndarray, v: np.ndarray, i: int, j: int) -> np.ndarray:
    """Where the side between corners i and j is 0."""
    return p[:, i] + (v[:, i] / (v[:, i] - v[:, j]))[:, None] * (p[:, j] - p[:, i])
