"""Which edges does a triangle mesh have, and which faces meet there? Pure NumPy, no Mitsuba variant needed.

Vertices are welded by position first: a UV seam or a split normal duplicates vertices without opening the
surface, and taking such a seam for a mesh border gives a wrong boundary term. Everything here depends on the
rest shape only; angles and convexity of the *current* shape are computed in `geometry`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ..errors import SceneError
from .slivers import is_sliver, share_of_edges

INVALID = np.uint32(0xFFFFFFFF)
"""Face index that stands for "no face" in `EdgeTopology.f1`."""

INVALID_CORNER = np.uint8(0xFF)
"""Corner index that stands for "no face" in `EdgeTopology.corner1`."""

WELD_TOLERANCE = 1e-6
"""Relative to the bounding box diagonal: ten times the rounding of float32 coordinates."""


@dataclass(frozen=True)
class EdgeTopology:
    """Edges of a triangle mesh, one row per edge (E rows); vertex and face indices are the mesh's own.

    `v0 → v1` runs in the winding direction of `f0`, and `f0 < f1`. An edge with more than two faces has no
    well-defined pair: it appears as one border row per face and is counted in `nonmanifold_edges`.
    """

    v0: np.ndarray
    """(E,) uint32, start of the edge, a vertex of `f0` (not welded)."""
    v1: np.ndarray
    """(E,) uint32, end of the edge, a vertex of `f0` (not welded)."""
    w0: np.ndarray
    """(E,) int64, `v0` welded: the same number for all vertices that coincide with it."""
    w1: np.ndarray
    """(E,) int64, `v1` welded."""
    f0: np.ndarray
    """(E,) uint32, first face."""
    f1: np.ndarray
    """(E,) uint32, second face, `INVALID` on a border."""
    corner0: np.ndarray
    """(E, 2) uint8, the corners of `f0` that are `v0` and `v1`; the second is the successor of the first."""
    corner1: np.ndarray
    """(E, 2) uint8, the corners of `f1` that coincide with `v0` and `v1`, `INVALID_CORNER` on a border."""
    split: np.ndarray
    """(E,) bool, the faces use different vertices along this edge: UVs or normals may jump here."""
    nonmanifold_edges: int
    """Number of edges with more than two faces."""
    degenerate_faces: int
    """Number of faces left out because they have (nearly) no area."""
    sliver_faces: int
    """Number of those of them whose three corners are in different places, in a row."""
    sliver_share: float
    """Their lengths, relative to those of all edges."""
    duplicate_faces: int
    """Number of faces left out because another face has the same three corner positions."""

    @property
    def border(self) -> np.ndarray:
        """(E,) bool, only one face on this edge."""
        return self.f1 == INVALID

    def __len__(self) -> int:
        return len(self.v0)


def weld_vertices(positions: np.ndarray, tolerance: float | None = None) -> np.ndarray:
    """Smallest index among the vertices that coincide with each vertex.

    Args: `positions` (V, 3), finite. `tolerance` is an absolute distance; `WELD_TOLERANCE` times the bounding
    box diagonal if omitted; 0 welds identical coordinates only.
    Returns: (V,) int64.

    Vertices closer than `tolerance` always end up together, those farther apart than 4 `tolerance` only
    through a chain of others. Two points closer than half a cell share a cell in at least one of the eight
    grids shifted by half a cell along some axes, so no cell border can separate them.
    """
    positions = _checked_positions(positions)
    if len(positions) == 0:
        return np.zeros(0, np.int64)
    if tolerance is None:
        tolerance = WELD_TOLERANCE * _diagonal(positions)
    rep = _weld_identical(positions)
    if not tolerance > _diagonal(positions) * 2.0**-50:  # cells would be smaller than the rounding
        return rep
    distinct = np.flatnonzero(rep == np.arange(len(rep)))
    scaled = (positions[distinct] - [axis.min() for axis in positions.T]) / (2 * tolerance)
    links = [_links_in_grid(scaled, np.array(shift)) for shift in product((0.0, 0.5), repeat=3)]
    a, b = (np.concatenate(side) for side in zip(*links, strict=True))
    if len(a) == 0:
        return rep
    return distinct[connected_components(len(distinct), a, b)][np.searchsorted(distinct, rep)]


def build_edge_topology(positions: np.ndarray, faces: np.ndarray, tolerance: float | None = None) -> EdgeTopology:
    """Unique edges of a triangle soup and the faces that meet there.

    Args: `positions` (V, 3), `faces` (F, 3) integer, in any winding; `tolerance` as in `weld_vertices`.
    Raises `SceneError` for an empty mesh, for indices out of range, and for NaN or infinite coordinates.
    """
    positions = _checked_positions(positions)
    faces = _checked_faces(faces, len(positions))
    if tolerance is None:
        tolerance = WELD_TOLERANCE * _diagonal(positions)
    welded = weld_vertices(positions, tolerance)[faces]

    collapsed = ~_every(welded != np.roll(welded, -1, axis=1))
    sliver = is_sliver(positions, welded, tolerance) & ~collapsed
    sound = ~(sliver | collapsed)
    kept = _first_of_duplicates(welded, np.flatnonzero(sound))

    # Half-edge h of kept face k: corners h % 3 and (h + 1) % 3 of face kept[h // 3].
    start = welded[kept].ravel()
    end = np.roll(welded[kept], -1, axis=1).ravel()
    order, first, count = _group(_pair_key(start, end))

    pair = first[count == 2]
    one = np.sort(order[np.repeat(count != 2, count)])
    h0 = np.concatenate([np.minimum(order[pair], order[pair + 1]), one])
    h1 = np.concatenate([np.maximum(order[pair], order[pair + 1]), np.full(len(one), -1)])
    return _rows(
        faces, kept, start, h0, h1,
        nonmanifold_edges=int(np.count_nonzero(count > 2)),
        degenerate_faces=int(len(faces) - np.count_nonzero(sound)),
        sliver_faces=int(np.count_nonzero(sliver)),
        sliver_share=share_of_edges(positions, welded[sliver], start, end) if sliver.any() else 0.0,
        duplicate_faces=int(np.count_nonzero(sound) - len(kept)),
    )  # fmt: skip


def _rows(faces, kept, start, h0, h1, **counts: int) -> EdgeTopology:
    """Turn pairs of half-edges (`h1` = −1 on a border) into the table of edges."""
    by_face = np.argsort(h0, kind="stable")  # neighbours in the table read neighbours in the face buffer
    h0, h1 = h0[by_face], h1[by_face]
    border = h1 < 0
    f0 = kept[h0 // 3]
    corner0 = np.stack([h0 % 3, (h0 + 1) % 3], axis=1)
    v = faces[f0[:, None], corner0]

    partner = np.where(border, 0, h1)
    f1 = kept[partner // 3]
    corner1 = np.stack([partner % 3, (partner + 1) % 3], axis=1)
    opposed = start[partner] != start[h0]  # a consistently wound neighbour runs from v1 to v0
    corner1 = np.where(opposed[:, None], corner1[:, ::-1], corner1)
    split = ~_every(faces[f1[:, None], corner1] == v) & ~border
    return EdgeTopology(
        v0=v[:, 0].astype(np.uint32),
        v1=v[:, 1].astype(np.uint32),
        w0=start[h0],
        w1=start[3 * (h0 // 3) + (h0 % 3 + 1) % 3],
        f0=f0.astype(np.uint32),
        f1=np.where(border, INVALID, f1).astype(np.uint32),
        corner0=corner0.astype(np.uint8),
        corner1=np.where(border[:, None], INVALID_CORNER, corner1).astype(np.uint8),
        split=split,
        **counts,
    )


def _checked_positions(positions: np.ndarray) -> np.ndarray:
    """(V, 3) float64, finite, or a `SceneError`."""
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise SceneError(f"vertex positions must have shape (V, 3), not {positions.shape}; reshape them")
    finite = _every(np.isfinite(positions))
    if not finite.all():
        bad = len(finite) - np.count_nonzero(finite)
        raise SceneError(
            f"{bad} of {len(finite)} vertices have NaN or infinite coordinates (the first is vertex "
            f"{int(np.argmin(finite))}); repair the mesh, or lower the step size of the optimisation"
        )
    return positions


def _checked_faces(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """(F, 3) int64 with F > 0 and every index in range, or a `SceneError`."""
    faces = np.asarray(faces)
    if faces.size == 0:
        raise SceneError("the mesh has no faces; remove the shape from the scene or fix its file")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise SceneError(f"faces must have shape (F, 3), not {faces.shape}; triangulate the mesh first")
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertex_count:
        raise SceneError(
            f"faces refer to vertices {faces.min()}..{faces.max()}, but the mesh has {vertex_count}; "
            "its face and vertex buffers do not belong together"
        )
    return faces


def _every(mask: np.ndarray) -> np.ndarray:
    """(N,) bool, all columns true; several times faster than `mask.all(axis=1)` on narrow arrays."""
    return np.logical_and.reduce(list(mask.T))


def _diagonal(positions: np.ndarray) -> float:
    if len(positions) == 0:
        return 0.0
    return float(np.linalg.norm([np.ptp(axis) for axis in positions.T]))  # ten times `np.ptp(axis=0)`


def _first_of_duplicates(welded: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Those of the faces `candidates` (ascending) that no earlier one repeats, whatever the winding."""
    tri = welded[candidates]
    a, b, c = tri.T
    lo, hi = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    mid = a + b + c - lo - hi
    key = _hash(lo, mid, hi)
    if not _has_repeats(key):
        return candidates
    order, first, count = _group(key)
    leader = np.empty(len(key), np.int64)
    leader[order] = np.repeat(order[first], count)
    same = (lo == lo[leader]) & (mid == mid[leader]) & (hi == hi[leader])
    return candidates[(leader == np.arange(len(key))) | ~same]


def _weld_identical(positions: np.ndarray) -> np.ndarray:
    """(V,) int64, smallest index among the vertices with exactly the same coordinates."""
    own = np.arange(len(positions))
    bits = (positions + 0.0).view(np.int64)  # adding 0 turns −0.0 into 0.0, which has other bits
    key = _hash(bits[:, 0], bits[:, 1], bits[:, 2])
    if not _has_repeats(key):
        return own
    order, first, count = _group(key)
    rep = np.empty(len(positions), np.int64)
    rep[order] = np.repeat(order[first], count)
    # Two different points with one hash would be welded across the scene: keep them apart instead.
    return np.where(_every(positions[rep] == positions), rep, own)


def _links_in_grid(scaled: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i, j) of points in the same cell of the unit grid moved by `shift`."""
    cell = np.floor(scaled + shift).astype(np.int64)
    key = _hash(cell[:, 0], cell[:, 1], cell[:, 2])
    if not _has_repeats(key):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order, first, count = _group(key)
    a, b = order, np.repeat(order[first], count)
    keep = (a != b) & _every(cell[a] == cell[b])
    return a[keep], b[keep]


def connected_components(n: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) smallest node in the connected component of each node of the graph with edges a—b."""
    label = np.arange(n)
    while True:
        low = np.minimum(label[a], label[b])
        if (low == label[a]).all() and (low == label[b]).all():
            return label
        for node in (label[a], label[b], a, b):  # hook the roots as well, so that chains halve
            np.minimum.at(label, node, low)
        label = label[label]


def _pair_key(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """One integer per unordered pair of vertex indices."""
    return (np.minimum(a, b).astype(np.uint64) << np.uint64(32)) | np.maximum(a, b).astype(np.uint64)


def _group(key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order that sorts `key` (ties by index), where each run of equal keys starts in it, and its length."""
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    return order, first, np.diff(np.append(first, len(key)))


def _has_repeats(key: np.ndarray) -> bool:
    """Whether some value occurs twice; sorting values is far cheaper than sorting indices."""
    ordered = np.sort(key)
    return bool((ordered[1:] == ordered[:-1]).any())


def _hash(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(N,) uint64, a mix of three integers per row (the finaliser of SplitMix64 after each)."""
    h = np.zeros(len(x), np.uint64)
    for part in (x, y, z):
        h = (h ^ part.astype(np.uint64, copy=False).view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = h ^ (h >> np.uint64(27))
    return h
