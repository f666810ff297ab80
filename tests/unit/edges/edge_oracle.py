"""Small meshes, and slow, obviously right answers about their edges."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np

BORDER, CONVEX, CONCAVE, COPLANAR = "border", "convex", "concave", "coplanar"


def tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    p = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    return p, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def split_cube() -> tuple[np.ndarray, np.ndarray]:
    """[-1, 1]³ with four vertices of its own per side, normals outward: 24 vertices, 12 faces."""
    p, f = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.zeros((4, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3] = np.array([-1, 1, 1, -1]) * sign
            side[:, (axis + 2) % 3] = [-1, -1, 1, 1]
            k = 4 * len(p)
            p.append(side)
            f += [[k, k + 1, k + 2], [k, k + 2, k + 3]]
    return np.concatenate(p), np.array(f)


def folded_quads(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Two unit quads that share the edge x = 0; the second one is bent up by `angle` [rad]. Normals +z."""
    c, s = np.cos(angle), np.sin(angle)
    p = np.array([[-1, 0, 0], [0, 0, 0], [0, 1, 0], [-1, 1, 0], [c, 0, s], [c, 1, s]], float)
    return p, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])


def icosphere(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed unit sphere with 20 · 4^levels faces and shared vertices."""
    g = (1 + 5**0.5) / 2
    p = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]]
    p += [[0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]
    f = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2]]
    f += [[10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5]]
    f += [[2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    p = [np.array(v, float) for v in p]
    for _ in range(levels):
        middle: dict[tuple[int, int], int] = {}

        def midpoint(a: int, b: int, middle=middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in middle:
                middle[key] = len(p)
                p.append(p[a] + p[b])
            return middle[key]

        finer = []
        for a, b, c in f:
            ab, bc, ca = midpoint(a, b), midpoint(b, c), midpoint(c, a)
            finer += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        f = finer
    p = np.array(p)
    return p / np.linalg.norm(p, axis=1, keepdims=True), np.array(f)


def uv_sphere(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Latitude/longitude sphere with a UV seam (duplicate vertices) and collapsed faces at the poles."""
    v, u = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij")
    p = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    b, c, d = a + columns + 1, a + columns + 2, a + 1
    return p, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def open_cylinder(columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit tube of height 1 with a UV seam and open ends."""
    u = np.linspace(0, 2 * np.pi, columns + 1)
    ring = np.stack([np.cos(u), np.sin(u)], axis=1)
    p = np.concatenate([np.c_[ring, np.zeros_like(u)], np.c_[ring, np.ones_like(u)]])
    a = np.arange(columns)
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return p, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def welded_by_brute_force(p: np.ndarray, tolerance: float) -> list[int]:
    """Smallest index in each vertex's connected component of "closer than tolerance", O(V²)."""
    label = list(range(len(p)))
    for i, j in combinations(range(len(p)), 2):
        if np.linalg.norm(p[i] - p[j]) < tolerance:
            low, high = sorted((label[i], label[j]))
            label = [low if k == high else k for k in label]
    return label


def edges_by_brute_force(p: np.ndarray, f: np.ndarray, tolerance: float) -> tuple[Counter, int, int, int]:
    """Multiset of (welded end points, faces); counts of non-manifold, degenerate, duplicate. O(F²)."""
    label = welded_by_brute_force(p, tolerance)
    sound, degenerate, duplicate = {}, 0, 0
    for index, corners in enumerate(f):
        a, b, c = p[corners]
        tri = frozenset(label[i] for i in corners)
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b))
        if len(tri) < 3 or np.linalg.norm(np.cross(b - a, c - a)) <= tolerance * longest:
            degenerate += 1
        elif tri in sound.values():
            duplicate += 1
        else:
            sound[index] = tri
    rows, nonmanifold = Counter(), 0
    edges = {frozenset(pair) for tri in sound.values() for pair in combinations(tri, 2)}
    for edge in edges:
        users = [index for index, tri in sound.items() if edge <= tri]
        nonmanifold += len(users) > 2
        groups = [tuple(users)] if len(users) <= 2 else [(index,) for index in users]
        rows.update((edge, group) for group in groups)
    return rows, nonmanifold, degenerate, duplicate


def classify_by_hand(p: np.ndarray, f: np.ndarray, topology) -> tuple[list[float], list[str]]:
    """Exterior angle [rad] and class of every edge, one at a time from the definitions, float64."""
    angles, classes = [], []
    for row in range(len(topology)):
        if topology.border[row]:
            angles.append(np.pi)
            classes.append(BORDER)
            continue
        a, b = p[topology.v0[row]], p[topology.v1[row]]
        along = (b - a) / np.linalg.norm(b - a)
        away = []
        for face, corners in ((topology.f0, topology.corner0), (topology.f1, topology.corner1)):
            arm = p[f[face[row]][3 - int(corners[row, 0]) - int(corners[row, 1])]] - a
            arm = arm - along * (arm @ along)
            away.append(arm / np.linalg.norm(arm))
        angle = np.pi - np.arccos(np.clip(away[0] @ away[1], -1, 1))
        outward = np.cross(along, away[0])  # v0 → v1 follows the winding of f0
        height = outward @ away[1]
        angles.append(angle)
        classes.append(COPLANAR if angle < 1e-4 else CONVEX if height < 0 else CONCAVE)
    return angles, classes
