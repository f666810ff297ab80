"""Edge topology against brute force, and against meshes whose edges can be counted by hand."""

from __future__ import annotations

import time
from collections import Counter

import edge_oracle as oracle
import numpy as np
import pytest

from psdr_jit.edges.topology import INVALID, INVALID_CORNER, WELD_TOLERANCE, build_edge_topology, weld_vertices
from psdr_jit.errors import SceneError


def rows_of(topology, p, tolerance):
    """The multiset of `oracle.edges_by_brute_force`, from our table."""
    label = oracle.welded_by_brute_force(p, tolerance)
    faces = [(a,) if b == INVALID else (a, b) for a, b in zip(topology.f0.tolist(), topology.f1.tolist())]
    ends = [frozenset((label[a], label[b])) for a, b in zip(topology.v0, topology.v1)]
    return Counter(zip(ends, faces))


def check_invariants(topology, p, f, tolerance):
    """What the docstring promises about every row."""
    rows = np.arange(len(topology))
    border = topology.border
    f0 = f[topology.f0]
    assert (f0[rows, topology.corner0[:, 0]] == topology.v0).all()
    assert (f0[rows, topology.corner0[:, 1]] == topology.v1).all()
    assert ((topology.corner0[:, 0] + 1) % 3 == topology.corner0[:, 1]).all(), "v0 → v1 is f0's own direction"
    assert (topology.f0[~border] < topology.f1[~border]).all()
    assert (topology.corner1[border] == INVALID_CORNER).all()
    assert not topology.split[border].any()

    inner = rows[~border]
    f1 = f[topology.f1[inner]]
    take = np.arange(len(inner))
    w0, w1 = f1[take, topology.corner1[inner, 0]], f1[take, topology.corner1[inner, 1]]
    assert (np.linalg.norm(p[w0] - p[topology.v0[inner]], axis=1) <= 4 * tolerance).all()
    assert (np.linalg.norm(p[w1] - p[topology.v1[inner]], axis=1) <= 4 * tolerance).all()
    assert (topology.split[inner] == ((w0 != topology.v0[inner]) | (w1 != topology.v1[inner]))).all()

    assert [topology.v0.dtype, topology.f1.dtype] == [np.uint32] * 2
    assert [topology.corner0.dtype, topology.corner1.dtype] == [np.uint8] * 2


def check_against_oracle(p, f):
    tolerance = WELD_TOLERANCE * np.linalg.norm(np.ptp(p, axis=0))
    topology = build_edge_topology(p, f)
    rows, nonmanifold, degenerate, duplicate = oracle.edges_by_brute_force(p, f, tolerance)
    assert rows_of(topology, p, tolerance) == rows
    assert topology.nonmanifold_edges == nonmanifold
    assert topology.degenerate_faces == degenerate
    assert topology.duplicate_faces == duplicate
    check_invariants(topology, p, f, tolerance)
    return topology


MESHES = {
    "tetrahedron": (oracle.tetrahedron(), 6, 0, 0),
    "split cube": (oracle.split_cube(), 18, 0, 12),
    "two quads": (oracle.folded_quads(0.5), 9, 6, 0),
    "icosahedron": (oracle.icosphere(0), 30, 0, 0),
    "icosphere": (oracle.icosphere(1), 120, 0, 0),
    # rows × columns quads; the faces at the poles collapse, the seam has one edge per row.
    "uv sphere": (oracle.uv_sphere(6, 8), 8 * 6 + 8 * 5 + 8 * 4, 0, 6 + 8 * 0),
    "uv cylinder": (oracle.open_cylinder(12), 12 * 3 + 12, 24, 1),
}


@pytest.mark.parametrize("name", MESHES)
def test_known_meshes(name):
    (p, f), edges, borders, splits = MESHES[name]
    topology = check_against_oracle(p, f)
    assert (len(topology), topology.border.sum()) == (edges, borders)
    if name != "uv sphere":  # pole vertices are split between columns as well
        assert topology.split.sum() == splits


def test_uv_sphere_counts_the_collapsed_faces():
    p, f = oracle.uv_sphere(6, 8)
    topology = build_edge_topology(p, f)
    assert (topology.degenerate_faces, topology.sliver_faces) == (2 * 8, 0)
    assert not topology.border.any()


def test_split_cube_classes():
    p, f = oracle.split_cube()
    angles, classes = oracle.classify_by_hand(p, f, build_edge_topology(p, f))
    assert Counter(classes) == {oracle.CONVEX: 12, oracle.COPLANAR: 6}
    assert np.allclose([a for a, c in zip(angles, classes) if c == oracle.CONVEX], np.pi / 2)


@pytest.mark.parametrize("levels", [2, 3])
def test_icosphere_is_closed(levels):
    p, f = oracle.icosphere(levels)
    topology = build_edge_topology(p, f)
    assert len(topology) == 30 * 4**levels
    assert not topology.border.any() and not topology.split.any()
    assert len(p) - len(topology) + len(f) == 2  # Euler


def test_nonmanifold_edge_gives_one_border_per_face():
    p = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0]], float)
    f = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    topology = check_against_oracle(p, f)
    assert topology.nonmanifold_edges == 1
    assert topology.border.sum() == 9


@pytest.mark.parametrize("copy", [[0, 1, 2], [1, 2, 0], [2, 1, 0]])
def test_duplicate_faces_are_dropped_first(copy):
    p, f = oracle.tetrahedron()
    topology = check_against_oracle(p, np.concatenate([f, [copy]]))
    assert (topology.duplicate_faces, topology.nonmanifold_edges, topology.border.sum()) == (1, 0, 0)


def test_inconsistent_winding_keeps_the_pairs():
    p, f = oracle.tetrahedron()
    f = f.copy()
    f[1] = f[1][::-1]
    topology = check_against_oracle(p, f)
    assert not topology.border.any()
    opposed = (topology.corner1[:, 1] + 1) % 3 == topology.corner1[:, 0]
    assert np.count_nonzero(~opposed) == 3  # the edges of the flipped face


@pytest.mark.parametrize("seed", range(12))
def test_random_soup(seed):
    """Few positions and many faces: every kind of coincidence, split vertex and duplicate occurs."""
    rng = np.random.default_rng(seed)
    grid = rng.integers(0, 3, (14, 3)).astype(float)
    p = grid[rng.integers(0, len(grid), 40)] + rng.uniform(-1e-9, 1e-9, (40, 3))
    topology = check_against_oracle(p, rng.integers(0, 40, (60, 3)))
    assert topology.nonmanifold_edges and topology.degenerate_faces, "the soup is too thin to test anything"


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0, 1.5, 17.0])
def test_weld_straddles_cell_borders(offset):
    """Pairs 1e-9 apart whose midpoint lies exactly on a cell border of the welding grid, in all axes."""
    tolerance = 1e-6
    border = offset * 2 * tolerance
    delta = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)]) * 0.5e-9
    p = np.concatenate([[[0, 0, 0]], np.array([border] * 3) + delta, [[1, 1, 1]]])
    rep = weld_vertices(p, tolerance)
    assert len(set(rep[1:9])) == 1
    assert rep[9] == 9


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_weld_distance(scale):
    """Below the tolerance always, above four tolerances never."""
    rng = np.random.default_rng(3)
    base = rng.uniform(-scale, scale, (2000, 3))
    direction = rng.normal(size=base.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    tolerance = WELD_TOLERANCE * scale
    for distance, same in ((0.0, True), (0.999, True), (4.001, False)):
        rep = weld_vertices(np.concatenate([base, base + direction * distance * tolerance]), tolerance)
        assert ((rep[2000:] == np.arange(2000)) == same).all()


def test_weld_chains_have_one_representative():
    p = np.zeros((200, 3))
    p[:, 0] = np.random.default_rng(0).permutation(200) * 0.9e-6
    assert (weld_vertices(p, 1e-6) == 0).all()


def test_weld_treats_signed_zeros_as_equal_and_zero_tolerance_as_exact():
    p = np.array([[0.0, 1, 0], [-0.0, 1, -0.0], [1e-12, 1, 0]])
    assert weld_vertices(p, 0).tolist() == [0, 0, 2]
    assert weld_vertices(np.zeros((0, 3))).tolist() == []


@pytest.mark.parametrize(
    ("p", "f", "message"),
    [
        ([[0, 0, np.nan], [1, np.inf, 0], [0, 1, 0]], [[0, 1, 2]], "2 of 3 vertices"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.zeros((0, 3), np.uint32), "no faces"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]], "the mesh has 3"),
        ([0.0, 0, 0, 1, 0, 0], [[0, 1, 2]], r"\(V, 3\)"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2, 0]], r"\(F, 3\)"),
    ],
)
def test_malformed_meshes_are_refused(p, f, message):
    with pytest.raises(SceneError, match=message):
        build_edge_topology(np.array(p, float), np.array(f))


def test_mesh_of_degenerate_faces_has_no_edges():
    p = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0]], float)
    topology = build_edge_topology(p, np.array([[0, 1, 2], [0, 3, 1]]))
    assert (len(topology), topology.degenerate_faces) == (0, 2)
    assert topology.sliver_faces == 1


def test_a_hundred_thousand_triangles_take_a_fraction_of_a_second():
    """A tenth of the target size in half its time limit, so that a busy machine does not fail the suite."""
    n = 224
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    p = np.stack([x, y, np.sin(7 * x) * np.cos(5 * y)], axis=-1).reshape(-1, 3).astype(np.float32)
    a = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :-1].ravel()
    f = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    began = time.perf_counter()
    topology = build_edge_topology(p, f)
    assert time.perf_counter() - began < 1.0
    assert len(topology) == 3 * n * n + 2 * n and topology.border.sum() == 4 * n
