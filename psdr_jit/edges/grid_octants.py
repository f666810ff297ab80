"""Octants of grids of signed distances that the surface passes through, found on the host (`core.sdf_octant`).

Along the axes X, Y, Z of an octant, in any order, the surface at a fixed Z is a hyperbola a₀ + a₁X + a₂Y + a₃XY = 0. A
row is the part of it on which X is the parameter, |∂f/∂X| ≤ |∂f/∂Y|, and on which f rises (σ = 1) or falls with Y.

Pure NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from .grid_rows import Columns


@dataclass
class OctantPieces(Columns):
    """Columns, one entry per piece."""

    corner: np.ndarray  # (K, 3) the grid point that the octant is about, along the axes of the grid
    axis: np.ndarray  # (K, 3) axes of the grid: X, Y and Z
    sign: np.ndarray  # (K, 3) ±1: do X, Y and Z point up their axes, or down?
    rises: np.ndarray  # σ


def octant_pieces(values: np.ndarray) -> OctantPieces:
    """All pieces of the surface of a grid (N, N, N), indexed (z, y, x)."""
    f = values.transpose(2, 1, 0).astype(np.float64)  # by x, y, z
    n = f.shape[0]
    steps = list(product((0, 1), repeat=3))
    corners = np.stack([f[tuple(slice(s, n - 1 + s) for s in step)] for step in steps])
    where = np.argwhere((corners.min(0) <= 0) & (corners.max(0) > 0))
    c = corners[(slice(None), *where.T)].reshape(2, 2, 2, -1)
    parts = []
    for step in steps:
        own = _octant(c, step)
        crossed = (own.min((0, 1, 2)) <= 0) & (own.max((0, 1, 2)) > 0)
        point = where[crossed] + np.array(step)
        sign = np.broadcast_to(1 - 2 * np.array(step), point.shape)
        parts += _pieces(own[..., crossed], point, sign)
    return OctantPieces.joined(parts)


def _octant(c: np.ndarray, step: tuple[int, int, int]) -> np.ndarray:
    """Values at the corners (2, 2, 2, K) of an octant of cells with corners `c`, from its grid point on."""
    for axis, s in enumerate(step):
        at, other = np.take(c, s, axis), np.take(c, 1 - s, axis)
        c = np.stack([at, (at + other) / 2], axis)
    return c


def _pieces(own: np.ndarray, point: np.ndarray, sign: np.ndarray) -> list[OctantPieces]:
    """Of octants with corners `own`, each in any order of axes and for both σ that occur in it."""
    rise = [np.diff(own, axis=a).reshape(4, -1) for a in range(3)]
    found = []
    for (x, y, z), σ in product(permutations(range(3)), (-1, 1)):
        low, high = rise[x].min(0), rise[x].max(0)
        least = np.where(low * high > 0, np.minimum(np.abs(low), np.abs(high)), 0)
        steepest = (σ * rise[y]).max(0)
        kept = (steepest > 0) & (steepest >= least)
        order = np.broadcast_to([x, y, z], (kept.sum(), 3))
        found.append(OctantPieces(point[kept], order, sign[kept][:, [x, y, z]], np.full(kept.sum(), σ)))
    return found
