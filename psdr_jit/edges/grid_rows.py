"""Pieces of the edges of grids of signed distances, found on the host: which cells and faces the surface crosses.

Within a cell the surface is smooth and has an outline (`core.sdf_cell`). On a face between cells it has a crease, as
only its values agree there; at the border of the grid it ends. On a face, a₀ + a₁X + a₂Y + a₃XY = 0 is a hyperbola. It
is cut into pieces along which X is the parameter and Y changes no faster: for both signs σ of a₂ + a₃X

    σ(a₂ + a₃X) ≥ √|a₁a₂ − a₀a₃|,     −σ(a₀ + a₁X) ≥ 0,     σ(a₀ + a₁X + a₂ + a₃X) ≥ 0,

of which each holds on one side of some X.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np

#: What a row is a piece of.
OUTLINE, CREASE, BORDER = range(3)

#: Relative to the gradient: curvature of a cell below which it has no outline, bend below which a face has no crease.
FLAT = 1e-5

#: Shortest piece of a face that counts.
SHORTEST = 1e-6


Pieces = TypeVar("Pieces", bound="Columns")


class Columns:
    """Of a dataclass of arrays, one entry per piece."""

    @classmethod
    def joined(cls: type[Pieces], parts: list[Pieces]) -> Pieces:
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass
class GridPieces(Columns):
    """Columns, one entry per piece. X, Y, Z are axes of the grid in the order that a row has them in."""

    part: np.ndarray  # OUTLINE, CREASE or BORDER
    base: np.ndarray  # index of the value at (X, Y, Z) = 0 of the cell, or of the face
    x: np.ndarray  # axes of the grid: X, the parameter of a face ...
    y: np.ndarray
    z: np.ndarray  # ... Z, the parameter of an outline, or across the face
    low: np.ndarray  # has the face a cell below it, as seen along Z ...
    high: np.ndarray  # ... and above it?
    root: np.ndarray  # of an outline: which of two, ±1
    start: np.ndarray  # parameter at which it begins ...
    length: np.ndarray  # ... and how far it goes
    weight: np.ndarray  # length × angle by which the surface turns there, in cells and radians


def grid_pieces(values: np.ndarray) -> GridPieces:
    """All pieces of the surface of a grid (N, N, N), indexed (z, y, x)."""
    f = values.transpose(2, 1, 0).astype(np.float64)  # by x, y, z
    n = f.shape[0]
    parts = []
    for z in range(3):
        x, y = (z + 1) % 3, (z + 2) % 3
        parts.append(_outlines(f, n, (x, y, z)))
        for axes in ((x, y, z), (y, x, z)):
            parts.append(_creases(f, n, axes))
    return GridPieces.joined(parts)


def _index(where: np.ndarray, axes: tuple[int, int, int], n: int) -> np.ndarray:
    """Index into the values of grid points (K, 3), given along `axes`."""
    stride = np.array([1, n, n * n])[list(axes)]
    return where @ stride


def _outlines(f: np.ndarray, n: int, axes: tuple[int, int, int]) -> GridPieces:
    """Of the cells that the surface bends in, along the axis Z of `axes`."""
    g = f.transpose(axes)
    corners = np.stack([g[i : n - 1 + i, j : n - 1 + j, k : n - 1 + k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    where = np.argwhere((corners.min(0) <= 0) & (corners.max(0) > 0))
    c = corners[(slice(None), *where.T)].reshape(2, 2, 2, -1)  # by Z, Y, X
    slope = np.sqrt(sum(np.diff(c, axis=k).mean((0, 1, 2)) ** 2 for k in range(3)))
    mixed = [np.abs(np.diff(np.diff(c, axis=a), axis=b)).max((0, 1, 2)) for a, b in ((0, 1), (0, 2), (1, 2))]
    turn = np.minimum(sum(mixed) / np.maximum(slope, np.finfo(float).tiny), np.pi)
    where, turn = where[turn > FLAT], turn[turn > FLAT]
    base = _index(where, axes, n)
    pieces = []
    for root in (-1.0, 1.0):
        pieces.append(_rows(OUTLINE, base, axes, root=root, start=0.0, length=1.0, weight=turn / 6))
    return GridPieces.joined(pieces)


def _creases(f: np.ndarray, n: int, axes: tuple[int, int, int]) -> GridPieces:
    """Of all faces across the axis Z of `axes`, where X is the parameter."""
    g = f.transpose(axes)
    a = np.stack([g[:-1, :-1], g[1:, :-1], g[:-1, 1:], g[1:, 1:]])  # corners of faces, (4, N − 1, N − 1, N)
    where = np.argwhere((a.min(0) <= 0) & (a.max(0) > 0))
    c = a[(slice(None), *where.T)]
    k = where[:, 2]
    below, above = (a[:, where[:, 0], where[:, 1], np.clip(k + step, 0, n - 1)] for step in (-1, 1))
    border = (k == 0) | (k == n - 1)
    slope = np.sqrt((c[1] - c[0] + c[3] - c[2]) ** 2 + (c[2] - c[0] + c[3] - c[1]) ** 2) / 2
    slope = np.hypot(slope, np.abs(above - below).mean(0) / 2)
    turn = np.abs(above + below - 2 * c).max(0) / np.maximum(slope, np.finfo(float).tiny)
    turn = np.where(border, np.pi, np.minimum(turn, np.pi))
    base = _index(where, axes, n)
    pieces = []
    for σ in (-1.0, 1.0):
        start, end = _interval(c, σ)
        kept = (end - start > SHORTEST) & (turn > FLAT)
        length = (end - start)[kept]
        pieces.append(
            _rows(np.where(border, BORDER, CREASE)[kept], base[kept], axes, low=(k > 0)[kept], high=(k < n - 1)[kept],
                  start=start[kept], length=length, weight=(length * turn[kept]))
        )  # fmt: skip
    return GridPieces.joined(pieces)


def _interval(c: np.ndarray, σ: float) -> tuple[np.ndarray, np.ndarray]:
    """From where to where X goes on faces with corners `c` (4, K)."""
    a0, a1, a2, a3 = c[0], c[1] - c[0], c[2] - c[0], c[3] - c[2] - c[1] + c[0]
    steep = np.sqrt(np.abs(a1 * a2 - a0 * a3))
    lower, upper = np.zeros_like(a0), np.ones_like(a0)
    for constant, slope in ((σ * a2 - steep, σ * a3), (-σ * a0, -σ * a1), (σ * (a0 + a2), σ * (a1 + a3))):
        with np.errstate(divide="ignore", invalid="ignore"):
            zero = -constant / slope
        lower = np.where(slope > 0, np.maximum(lower, zero), lower)
        upper = np.where(slope < 0, np.minimum(upper, zero), upper)
        upper = np.where((slope == 0) & (constant < 0), -1, upper)
    # both signs hold all along where a₂ + a₃X is 0: then Y is no function of X
    return lower, np.where((a2 == 0) & (a3 == 0), -1, upper)


def _rows(part, base: np.ndarray, axes: tuple[int, int, int], low=True, high=True, root=0.0, **floats) -> GridPieces:
    columns = {"part": part, "x": axes[0], "y": axes[1], "z": axes[2], "low": low, "high": high, "root": root, **floats}
    full = {name: np.broadcast_to(value, base.shape) for name, value in columns.items()}
    return GridPieces(base=base, **full)
