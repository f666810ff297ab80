"""Small meshes by name, as arrays: closed and open, welded, none of which cuts into itself.

All of them fill about the cube from -1 to 1. Faces are wound so that normals point outwards, or up.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks import meshes as benchmark_meshes

Arrays = tuple[np.ndarray, np.ndarray]  # vertices (V, 3), faces (F, 3)

RING, TUBE = 0.68, 0.3  # radii of the torus
BUMP = 0.3  # height of the waves of a sheet
RIDGE = 0.6  # height of the tent


def ball(segments: int) -> Arrays:
    points, faces = benchmark_meshes.ball(max(3, segments // 2), segments)
    return (points - benchmark_meshes.CENTRE) / benchmark_meshes.RADIUS, faces


def torus(segments: int) -> Arrays:
    """About the y axis, half as many segments around the tube as along the ring."""
    around = max(4, segments // 2)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(segments), np.arange(around), indexing="ij"))
    φ, θ = 2 * np.pi * i / segments, 2 * np.pi * j / around
    radius = RING + TUBE * np.cos(θ)
    points = np.stack([radius * np.cos(φ), TUBE * np.sin(θ), radius * np.sin(φ)], -1)
    right, up = (i + 1) % segments, (j + 1) % around
    a, b, c, d = (u * around + v for u, v in ((i, j), (right, j), (right, up), (i, up)))
    return points, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def box(_: int) -> Arrays:
    """A cube of eight vertices, which can be moved one by one."""
    points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def prism(segments: int) -> Arrays:
    """Closed, with a regular polygon as base."""
    turn = 2 * np.pi * np.arange(segments) / segments
    rim = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1)
    points = np.concatenate([rim + [0, 1, 0], rim - [0, 1, 0], [[0, 1, 0], [0, -1, 0]]])
    i = np.arange(segments)
    k, top, low = (i + 1) % segments, 0 * i + 2 * segments, 0 * i + 2 * segments + 1
    n = segments
    sides = [np.stack([i, k, n + i], 1), np.stack([k, n + k, n + i], 1)]
    return points, np.concatenate([*sides, np.stack([top, k, i], 1), np.stack([low, n + i, n + k], 1)])


def sheet(cells: int) -> Arrays:
    """Open, a wavy square."""
    ticks, n = np.linspace(-1, 1, cells + 1), cells + 1
    x, z = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    points = np.stack([x, BUMP * np.sin(2.3 * x + 0.4) * np.cos(1.9 * z), z], -1)
    return points, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def tent(_: int) -> Arrays:
    """Open, two rectangles that meet in a ridge."""
    points = np.array([[-1, 0, -1], [-1, 0, 1], [0, RIDGE, -1], [0, RIDGE, 1], [1, 0, -1], [1, 0, 1]], dtype=float)
    return points, np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]])


def in_four(points: np.ndarray, faces: np.ndarray) -> Arrays:
    """The same surface of four times as many faces."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    sides, middle = np.unique(sides, axis=0, return_inverse=True)
    m = len(points) + middle.reshape(-1, 3)
    a, b, c = faces.T
    small = np.concatenate([np.stack(corners, 1) for corners in (
        (a, m[:, 0], m[:, 2]), (m[:, 0], b, m[:, 1]), (m[:, 2], m[:, 1], c), (m[:, 0], m[:, 1], m[:, 2]))])
    return np.concatenate([points, points[sides].mean(1)]), small


def square(_: int) -> Arrays:
    """What Mitsuba's `rectangle` is."""
    return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float), np.array([[0, 1, 2], [0, 2, 3]])


MESHES: dict[str, Callable[[int], Arrays]] = {f.__name__: f for f in (ball, torus, box, prism, sheet, tent, square)}
CLOSED = ("ball", "torus", "box", "prism")
OPEN = ("sheet", "tent")
