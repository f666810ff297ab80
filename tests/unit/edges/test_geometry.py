"""Angles, convexity and normals of edges against a float64 evaluation of the definitions."""

from __future__ import annotations

import drjit as dr
import edge_oracle as oracle
import mitsuba as mi
import numpy as np
import pytest
from variants import activate

from psdr_jit.edges.geometry import edge_geometry, upload_topology
from psdr_jit.edges.topology import build_edge_topology


@pytest.fixture(autouse=True)
def variant():
    activate("llvm_ad_rgb")


def on_device(p, f):
    topology = build_edge_topology(p, f)
    positions = mi.Point3f(np.ascontiguousarray(p.T.astype(np.float32)))
    faces = mi.Vector3u(np.ascontiguousarray(f.T.astype(np.uint32)))
    return topology, edge_geometry(positions, faces, upload_topology(topology))


def flipped(mesh, faces):
    p, f = mesh
    f = f.copy()
    f[faces] = f[faces][:, ::-1]
    return p, f


MESHES = {
    "tetrahedron": oracle.tetrahedron(),
    "split cube": oracle.split_cube(),
    "convex fold": oracle.folded_quads(-0.7),
    "concave fold": oracle.folded_quads(0.7),
    "flat fold": oracle.folded_quads(0.0),
    "sharp fold": oracle.folded_quads(np.pi - 0.01),
    "icosphere": oracle.icosphere(2),
    "uv sphere": oracle.uv_sphere(7, 9),
    "tube": oracle.open_cylinder(16),
    "inconsistent fold": flipped(oracle.folded_quads(0.7), [2, 3]),
    "inconsistent cube": flipped(oracle.split_cube(), [1, 4, 9]),
}


@pytest.mark.parametrize("name", MESHES)
def test_matches_the_definitions(name):
    p, f = MESHES[name]
    topology, edge = on_device(p, f)
    angles, classes = (np.array(x) for x in oracle.classify_by_hand(p, f, topology))
    assert np.allclose(edge.angle.numpy(), angles, atol=2e-5)
    flat = classes == oracle.COPLANAR
    assert (edge.convex.numpy()[~flat] == (classes == oracle.CONVEX)[~flat]).all()
    assert (edge.border.numpy() == (classes == oracle.BORDER)).all()
    length = np.linalg.norm(p[topology.v1] - p[topology.v0], axis=1)
    assert np.allclose(edge.length.numpy(), length, rtol=1e-5)


@pytest.mark.parametrize("name", MESHES)
def test_normals_are_unit_perpendicular_and_on_one_side(name):
    p, f = MESHES[name]
    topology, edge = on_device(p, f)
    for n in (edge.n0, edge.n1):
        assert dr.allclose(dr.norm(n), 1, atol=1e-5)
        assert dr.allclose(dr.dot(n, dr.normalize(edge.p1 - edge.p0)), 0, atol=1e-5)
    a, b, c = (p[f[topology.f0]][:, k] for k in range(3))
    winding = np.cross(b - a, c - a)
    winding /= np.linalg.norm(winding, axis=1, keepdims=True)
    assert np.allclose(edge.n0.numpy().T, winding, atol=1e-5)
    assert (edge.n1.numpy()[:, topology.border] == edge.n0.numpy()[:, topology.border]).all()


def test_flipping_a_face_moves_no_silhouette():
    rng = np.random.default_rng(1)
    p, f = oracle.icosphere(2)
    turned = rng.random(len(f)) < 0.5
    direction = mi.Vector3f(0.3, -0.5, 0.81)
    silhouettes = []
    for mesh in ((p, f), flipped((p, f), turned)):
        topology, edge = on_device(*mesh)
        seen = (dr.dot(edge.n0, direction) * dr.dot(edge.n1, direction) < 0).numpy()
        silhouettes.append({tuple(sorted(pair)) for pair in zip(topology.v0[seen], topology.v1[seen])})
    assert silhouettes[0] == silhouettes[1] and len(silhouettes[0]) > 10


def test_cube_of_mitsuba_has_twelve_right_angles():
    mesh = mi.load_dict({"type": "cube"})
    p = mesh.vertex_positions_buffer().numpy().reshape(-1, 3)
    f = mesh.faces_buffer().numpy().reshape(-1, 3)
    _, edge = on_device(p, f)
    angle = edge.angle.numpy()
    assert np.count_nonzero(np.abs(angle - np.pi / 2) < 1e-6) == 12
    assert np.count_nonzero(np.abs(angle) < 1e-6) == 6
    assert edge.convex.numpy()[angle > 1].all()


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6])
def test_angles_do_not_depend_on_the_scale(scale):
    p, f = oracle.tetrahedron()
    _, edge = on_device(p * scale, f)
    assert dr.allclose(edge.angle, np.pi - np.arccos(1 / 3), rtol=1e-5)


def test_collapsed_face_gives_no_nan():
    p, f = oracle.tetrahedron()
    topology = upload_topology(build_edge_topology(p, f))
    positions = mi.Point3f(np.ascontiguousarray((p * [1, 1, 0]).T.astype(np.float32)) * 0)
    edge = edge_geometry(positions, mi.Vector3u(np.ascontiguousarray(f.T.astype(np.uint32))), topology)
    assert dr.all(dr.isfinite(edge.angle) & dr.isfinite(edge.length) & (edge.length == 0))


def test_result_is_detached():
    p, f = oracle.tetrahedron()
    topology = upload_topology(build_edge_topology(p, f))
    positions = mi.Point3f(np.ascontiguousarray(p.T.astype(np.float32)))
    dr.enable_grad(positions)
    edge = edge_geometry(positions, mi.Vector3u(np.ascontiguousarray(f.T.astype(np.uint32))), topology)
    assert not dr.grad_enabled(edge.p0, edge.n0, edge.n1, edge.length, edge.angle)


@pytest.mark.parametrize(("degrees", "size"), [(20, 1.0), (60, 1.0), (60, 0.1), (89, 1.0), (120, 1.0)])
def test_faces_are_looked_at_in_front_of_each_other(degrees, size):
    """In a corner between two faces, a ray that Mitsuba lifts off one of them does not start behind the other."""
    φ = np.deg2rad(degrees)
    p = size * np.array([(0, 0, 0), (0, 1, 0), (1, 0.5, 0), (np.cos(φ), 0.5, np.sin(φ))])
    topology, edge = on_device(p, np.array([(0, 1, 2), (1, 0, 3)]))
    row = int(np.flatnonzero(~topology.border)[0])
    inset, n0, n1 = np.array(edge.inset0)[row], np.array(edge.n0).T[row], np.array(edge.n1).T[row]
    start = (1 - inset) * p[:2].mean(0) + inset * p[:3].mean(0)
    sides = [np.sign((p[3] - p[0]) @ n0), np.sign((p[2] - p[0]) @ n1)]  # of the faces that look at each other
    lifted = start + 8.9e-5 * (1 + size) * sides[0] * n0
    assert sides[1] * (lifted - p[0]) @ n1 > 0
    assert inset < 0.5 and (degrees < 90 or inset == pytest.approx(3e-4))
