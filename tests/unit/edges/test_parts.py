"""Surfaces of one mesh, and where they cross: the same as between meshes of their own."""

from __future__ import annotations

import numpy as np

from benchmarks import meshes
from psdr_jit.edges.intersections import TriangleMesh, mesh_mesh
from psdr_jit.edges.parts import MAX_PARTS, cut_parts, parts_of
from psdr_jit.edges.topology import build_edge_topology


def as_mesh(points: np.ndarray, faces: np.ndarray):
    t = build_edge_topology(points, faces)
    return TriangleMesh(points, faces, np.stack([t.v0, t.v1], 1), np.stack([t.f0, t.f1], 1)), parts_of(t, faces)


def copies(*shifts) -> tuple[np.ndarray, np.ndarray]:
    points, faces = meshes.round_ball(200)
    every = range(len(shifts))
    return np.concatenate([points + s for s in shifts]), np.concatenate([faces + k * len(points) for k in every])


def test_one_surface_has_no_parts():
    assert as_mesh(*copies((0, 0, 0)))[1] == ()
    assert as_mesh(*copies(*[(k, 0, 0) for k in range(MAX_PARTS + 1)]))[1] == ()


def test_parts_share_out_the_mesh():
    mesh, parts = as_mesh(*copies((0, 0, 0), (0.3, 0.1, 0), (5, 0, 0)))
    assert len(parts) == 3
    for name, whole in (("faces", mesh.faces), ("edges", mesh.edges), ("vertices", mesh.positions)):
        assert np.array_equal(np.sort(np.concatenate([getattr(p, name) for p in parts])), np.arange(len(whole)))


def test_parts_cross_as_meshes_of_their_own_do():
    shift = np.array([0.3, 0.1, 0.05])
    mesh, parts = as_mesh(*copies((0, 0, 0), shift))
    points, faces = copies((0, 0, 0))
    alone, other = as_mesh(points, faces)[0], as_mesh(points + shift, faces)[0]
    within, between = cut_parts(mesh, parts), mesh_mesh(alone, other)
    assert len(within.start) == len(between.start) > 20
    order, expected = np.lexsort(within.start.T), np.lexsort(between.start.T)
    assert np.allclose(within.start[order], between.start[expected])
    assert np.array_equal(within.face_a[order], between.face_a[expected])
    assert np.array_equal(within.face_b[order] - len(faces), between.face_b[expected])
