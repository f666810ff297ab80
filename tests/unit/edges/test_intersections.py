"""Intersection curves of meshes and balls against closed forms: lengths, planes, and what is not an intersection."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import meshes
from psdr_jit.edges import intersections as cut
from psdr_jit.edges import round_cuts
from psdr_jit.edges.near_pairs import near_pairs
from psdr_jit.edges.topology import build_edge_topology

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                       [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
SQUARE = np.array([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]], float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def mesh(positions: np.ndarray, faces: np.ndarray) -> cut.TriangleMesh:
    topology = build_edge_topology(positions, faces)
    edges = np.stack([topology.v0, topology.v1], 1)
    return cut.TriangleMesh(positions, faces, edges, np.stack([topology.f0, topology.f1], 1))


def rotation(rng) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def length(found) -> float:
    return np.linalg.norm(found.end - found.start, axis=1).sum()


def test_cube_in_a_floor():
    """An upright cube cuts a plane in a square, wherever the plane's diagonal runs."""
    found = cut.mesh_mesh(mesh(CUBE * 0.5 + [0.1, 0.2, -0.3], CUBE_FACES), mesh(SQUARE, SQUARE_FACES))
    assert length(found) == pytest.approx(4, abs=1e-9)
    assert np.allclose(found.start[:, 1], 0) and np.allclose(found.end[:, 1], 0)
    assert np.allclose(np.abs(found.start - [0.1, 0, -0.3]).max(1), 0.5)


@pytest.mark.parametrize("seed", range(5))
def test_rotated_cube(seed):
    """Perimeter of the convex hull of the section, and both surfaces contain every point."""
    rng = np.random.default_rng(seed)
    turned = CUBE @ rotation(rng).T * 0.7 + rng.normal(size=3) * 0.2
    a = mesh(turned, CUBE_FACES)
    found = cut.mesh_mesh(a, mesh(SQUARE, SQUARE_FACES))
    points = np.concatenate([found.start, found.end])
    centre = points.mean(0)
    angle = np.arctan2(points[:, 2] - centre[2], points[:, 0] - centre[0])
    hull = points[np.argsort(angle)]
    assert length(found) == pytest.approx(np.linalg.norm(hull - np.roll(hull, 1, 0), axis=1).sum(), rel=1e-6)
    for face, x in ((found.face_a, found.start), (found.face_a, found.end)):
        corners = turned[CUBE_FACES[face]]
        weights = cut.barycentric(x, corners)
        assert weights.min() > -1e-6
        assert np.allclose(np.einsum("ij,ijk->ik", weights, corners), x, atol=1e-9)


def test_swapping_the_meshes_changes_nothing():
    a, b = mesh(CUBE * 0.5 + [0.1, 0.2, 0], CUBE_FACES), mesh(SQUARE, SQUARE_FACES)
    there, back = cut.mesh_mesh(a, b), cut.mesh_mesh(b, a)
    assert length(there) == pytest.approx(length(back))
    assert sorted(zip(there.face_a, there.face_b, strict=True)) == sorted(zip(back.face_b, back.face_a, strict=True))


@pytest.mark.parametrize("height", [0.5, 0.5 + 1e-7, 0.5 - 1e-7, 0.6, 3.0])
def test_resting_and_floating_do_not_cut(height):
    found = cut.mesh_mesh(mesh(CUBE * 0.5 + [0.1, height, 0], CUBE_FACES), mesh(SQUARE, SQUARE_FACES))
    assert len(found.face_a) == 0


def test_two_cubes():
    """Two equal upright cubes, one shifted along the diagonal: their surfaces meet in a closed hexagon of edges 1."""
    found = cut.mesh_mesh(mesh(CUBE, CUBE_FACES), mesh(CUBE + 1.0, CUBE_FACES))
    assert length(found) == pytest.approx(6, abs=1e-9)


def test_too_dense(monkeypatch):
    monkeypatch.setattr(cut, "ALL_PAIRS", 0)
    monkeypatch.setattr(cut, "MAX_TESTS", 10)
    with pytest.raises(cut.TooManyPairs):
        cut.mesh_mesh(mesh(CUBE, CUBE_FACES), mesh(CUBE + 0.5, CUBE_FACES))


@pytest.mark.parametrize("height", [0.0, 0.3, -0.6])
def test_ball_in_a_floor(height):
    found = round_cuts.ball_mesh(np.array([0.2, height, 0.1]), 0.8, mesh(SQUARE, SQUARE_FACES), 64)
    size = np.sqrt(0.8**2 - height**2)
    half = np.linalg.norm(found.end - found.start, axis=1) / 2 / found.radius
    assert (2 * found.radius * np.arcsin(half)).sum() == pytest.approx(2 * np.pi * size, rel=1e-9)
    assert np.allclose(found.radius, size) and np.allclose(found.centre, [0.2, 0, 0.1])
    assert np.allclose(np.linalg.norm(found.start - found.centre, axis=1), size)


def test_ball_over_the_border_of_a_floor():
    """Half of the circle lies beside the plane."""
    found = round_cuts.ball_mesh(np.array([3.0, 0, 0.1]), 0.8, mesh(SQUARE, SQUARE_FACES), 64)
    half = np.linalg.norm(found.end - found.start, axis=1) / 2 / found.radius
    assert (2 * found.radius * np.arcsin(half)).sum() == pytest.approx(np.pi * 0.8, rel=1e-9)
    assert found.start[:, 0].max() <= 3 + 1e-9


def test_touching_ball():
    assert len(round_cuts.ball_mesh(np.array([0, 0.8, 0]), 0.8, mesh(SQUARE, SQUARE_FACES), 64).face) == 0


@pytest.mark.parametrize("distance", [0.0, 0.9, 1.1])
def test_a_ball_looks_at_few_faces_of_a_fine_mesh(distance, monkeypatch):
    """Around a ball of 16 000 faces, and through its side; looked at one by one, all of them take 30 s."""
    points, faces = meshes.ball(64, 128)
    unit = mesh((points - meshes.CENTRE) / meshes.RADIUS, faces)
    looked, barycentric = set(), cut.barycentric
    monkeypatch.setattr(cut, "barycentric", lambda x, face: looked.add(face.tobytes()) or barycentric(x, face))
    found = round_cuts.ball_mesh(np.array([distance, 0, 0]), 1.2, unit, 64)
    height = (distance**2 + 1.2**2 - 1) / (2 * distance) if distance else 1.2  # of the circle's plane, from the ball
    expected = 2 * np.pi * np.sqrt(1.2**2 - height**2)
    half = np.linalg.norm(found.end - found.start, axis=1) / 2 / np.maximum(found.radius, 1e-9)
    assert (2 * found.radius * np.arcsin(half)).sum() == pytest.approx(expected, rel=0.01)
    assert len(looked) < len(faces) / 20


@pytest.mark.parametrize("lean", [0.0, 0.4, 1.2])
def test_cylinder_in_a_floor(lean):
    """An ellipse with the half axes R and R / cos(lean): its points lie on both, and its length is an integral."""
    axis = np.array([np.sin(lean), np.cos(lean), 0])
    tube = round_cuts.Tube(np.array([0.2, 0, 0.1]) - axis, axis, 2.0, 0.3)
    found = round_cuts.cylinder_mesh(tube, mesh(SQUARE, SQUARE_FACES), 4000)
    offset = found.start - tube.base
    radial = offset - (offset @ axis)[:, None] * axis
    assert np.allclose(np.linalg.norm(radial, axis=1), 0.3) and np.allclose(found.start[:, 1], 0)
    θ = np.linspace(0, 2 * np.pi, 100001)
    ellipse = 0.3 * np.hypot(np.sin(θ) / np.cos(lean), np.cos(θ)).mean() * 2 * np.pi
    assert np.linalg.norm(found.end - found.start, axis=1).sum() == pytest.approx(ellipse, rel=1e-4)


def test_cylinder_that_ends_in_a_floor():
    """Nothing of the curve lies beyond its height."""
    tube = round_cuts.Tube(np.array([0, -1.0, 0]), np.array([0.6, 0.8, 0]), 1.25, 0.3)
    found = round_cuts.cylinder_mesh(tube, mesh(SQUARE, SQUARE_FACES), 64)
    along = (np.concatenate([found.start, found.end]) - tube.base) @ tube.axis
    assert len(found.face) and along.max() == pytest.approx(1.25) and along.min() < 1.25


def test_cylinder_that_lies_in_a_floor():
    """Two straight lines of its length, apart by the chord."""
    tube = round_cuts.Tube(np.array([-0.5, 0.1, 0.2]), np.array([1.0, 0, 0]), 1.0, 0.3)
    found = round_cuts.cylinder_mesh(tube, mesh(SQUARE, SQUARE_FACES), 64)
    assert np.linalg.norm(found.end - found.start, axis=1).sum() == pytest.approx(2.0)
    assert not found.radius.any()
    assert np.ptp(found.start[:, 2]) == pytest.approx(2 * np.sqrt(0.3**2 - 0.1**2))


@pytest.mark.parametrize("spread", [0.02, 0.3])
def test_near_pairs_are_all_that_overlap(spread):
    """Every pair of overlapping boxes, once, whether they are small or span most of the grid."""
    rng = np.random.default_rng(7)
    a, b = (rng.random((n, 3)) for n in (700, 500))
    size_a, size_b = (spread * rng.random((n, 3)) * rng.random((n, 1)) for n in (700, 500))
    parts = list(near_pairs(a, a + size_a, b, b + size_b))
    i, j = (np.concatenate(column) for column in zip(*parts, strict=True))
    expected = np.all((a[:, None] <= b + size_b) & (b <= (a + size_a)[:, None]), axis=2)
    assert len(i) == expected.sum()
    assert expected[i, j].all() and len(set(zip(i.tolist(), j.tolist(), strict=True))) == len(i)


def test_two_fine_balls():
    """Too many edges and faces to test them all: the circle of two unit balls at a distance of 1.2."""
    points, faces = meshes.ball(64, 128)
    unit = (points - meshes.CENTRE) / meshes.RADIUS
    turned = unit @ rotation(np.random.default_rng(3)).T + [1.2, 0, 0]
    a, b = mesh(unit, faces), mesh(turned, faces)
    assert len(a.edges) * len(b.faces) / 4 > cut.ALL_PAIRS
    found = cut.mesh_mesh(a, b)
    # segments of which an end is within the tolerance of a corner are left out: 1.4 % at this fineness
    assert length(found) == pytest.approx(2 * np.pi * 0.8, rel=2e-2)
    assert np.abs(found.start[:, 0] - 0.6).max() < 2e-3


def test_one_surface_that_cuts_itself():
    """A strip bent as the letter alpha crosses itself in a straight line; a fold does so from a shared corner on."""
    bends = np.array([(-1, -0.5), (1, 0.5), (1, -0.5), (-1, 0.5)])
    strip = np.concatenate([np.insert(bends, 2, height, axis=1) for height in (-0.4, 0.4)])
    faces = np.array([t for k in range(3) for t in ((k, k + 1, k + 5), (k, k + 5, k + 4))])
    found = cut.mesh_itself(mesh(strip, faces))
    assert length(found) == pytest.approx(0.8, abs=1e-9)
    assert np.allclose(np.concatenate([found.start, found.end])[:, :2], 0)
    open_strip = cut.mesh_itself(mesh(strip * [1, 1, 1] + np.repeat([[0, 0, 0], [0.1, 0, 0]], 4, 0), faces[:4]))
    assert len(open_strip.face_a) == 0
    fold = np.array([(0, 0, 0), (2, -1, 0), (2, 1, 0), (1, 0, -1), (1, 0, 1)], float)
    found = cut.mesh_itself(mesh(fold, np.array([(0, 1, 2), (0, 3, 4)])))
    assert len(found.face_a) == 1 and length(found) == pytest.approx(1)
