"""How far two surfaces are from each other."""

from __future__ import annotations

import numpy as np

SAMPLES = 3000  # on each surface
CHUNK = 100  # of them at once

Mesh = tuple[np.ndarray, np.ndarray]  # positions (V, 3), faces (F, 3)


def chamfer(a: Mesh, b: Mesh, seed: int = 0) -> float:
    """Mean distance from points of either surface to the other one, both directions added up.

    Points are uniform by area; distances are exact, to triangles and not to other points.
    """
    rng = np.random.default_rng(seed)
    return float(_to_surface(_points(a, rng), b).mean() + _to_surface(_points(b, rng), a).mean())


def _points(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    a, b, c = (mesh[0][mesh[1][:, k]].astype(float) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    root, v = np.sqrt(rng.random(SAMPLES)), rng.random(SAMPLES)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    return np.einsum("nk,nkd->nd", weights, np.stack([a[face], b[face], c[face]], 1))


def _to_surface(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    corners = [mesh[0][mesh[1][:, k]].astype(float) for k in range(3)]
    parts = np.array_split(points, max(1, len(points) // CHUNK))
    return np.concatenate([_to_triangles(part, *corners).min(1) for part in parts])


def _to_triangles(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(N, F) distances of points to triangles: to the plane where the foot is inside, else to the nearest side."""
    sides = np.min([_to_segments(p, x, y) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    n = np.cross(b - a, c - a)
    n /= np.maximum(np.linalg.norm(n, axis=1), 1e-30)[:, None]
    inside = np.ones((len(p), len(a)), bool)
    for x, y in ((a, b), (b, c), (c, a)):
        inward = np.cross(n, y - x)
        inside &= p @ inward.T >= np.einsum("fd,fd->f", inward, x)
    height = np.abs(p @ n.T - np.einsum("fd,fd->f", n, a))
    return np.where(inside, height, sides)


def _to_segments(p: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    d = y - x
    t = (p @ d.T - np.einsum("fd,fd->f", x, d)) / np.maximum(np.einsum("fd,fd->f", d, d), 1e-30)
    foot = x[None] + np.clip(t, 0, 1)[..., None] * d[None]
    return np.linalg.norm(p[:, None] - foot, axis=-1)
