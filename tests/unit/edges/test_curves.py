"""Curves of disks, cylinders and spheres: on the shape, tangent to the view, and with the right derivative."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.edges.curves import (
    CURVES_OF,
    PIECES,
    Curve,
    curve_point,
    curve_set,
    local_viewpoint,
    own_surface,
    transform_point,
)

N = 64
VIEWS = {"point": (3.0, -1.5, 2.0, 1.0), "near": (1.2, 0.3, 0.4, 1.0), "direction": (0.6, 0.64, 0.48, 0.0)}
RIMS = (Curve.DISK_RIM, Curve.CYLINDER_BOTTOM, Curve.CYLINDER_TOP)
LINES = (Curve.CYLINDER_LEFT, Curve.CYLINDER_RIGHT)


def evaluate(curve: Curve, view: tuple, s: np.ndarray | None = None):
    s = (np.arange(N) + 0.5) / N if s is None else s
    p = curve_point(dr.full(mi.UInt32, int(curve), len(s)), mi.Float(s), mi.Vector4f(*view))
    return np.array(p.x).T, np.array(p.dx_ds).T, np.array(p.outward).T, np.array(p.valid & mi.Bool([True] * len(s)))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("curve", list(Curve), ids=lambda c: c.name)
def test_points_lie_on_the_shape(variant, curve, view):
    x, _, outward, valid = evaluate(curve, VIEWS[view])
    assert valid.all()
    radius = np.linalg.norm(x if curve == Curve.SPHERE_SILHOUETTE else x[:, :2], axis=1)
    assert np.allclose(radius, 1, atol=1e-5)
    if curve in RIMS:
        assert np.all(x[:, 2] == (1 if curve == Curve.CYLINDER_TOP else 0))
    if curve in LINES:
        assert np.all((x[:, 2] >= 0) & (x[:, 2] <= 1))
    # outward leads off the surface: beyond an end of the tube, or to a larger radius
    y = x + 0.1 * outward
    radius = np.linalg.norm(y if curve == Curve.SPHERE_SILHOUETTE else y[:, :2], axis=1)
    beyond = (y[:, 2] < -0.05) | (y[:, 2] > 1.05) if curve in RIMS[1:] else radius > 1.05
    assert np.all(beyond | (radius > 1.05))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("curve", [*LINES, Curve.SPHERE_SILHOUETTE], ids=lambda c: c.name)
def test_silhouettes_are_tangent_to_the_view(variant, curve, view):
    """n · (c − w x) = 0, with the normal n of the surface and the homogeneous viewpoint (c, w)."""
    x, _, _, _ = evaluate(curve, VIEWS[view])
    c = np.array(VIEWS[view])
    n = x if curve == Curve.SPHERE_SILHOUETTE else x * np.array([1, 1, 0])
    assert np.abs(np.sum(n * (c[:3] - c[3] * x), axis=1)).max() < 1e-5


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("curve", list(Curve), ids=lambda c: c.name)
def test_derivative_against_finite_differences(variant, curve, view):
    s, h = (np.arange(N) + 0.5) / N, 1 / 256
    _, dx, _, _ = evaluate(curve, VIEWS[view], s)
    above, below = (evaluate(curve, VIEWS[view], s + d)[0].astype(np.float64) for d in (h, -h))
    difference = (above - below) / (2 * h)
    assert np.abs(dx - difference).max() < 2e-3 * max(1.0, np.abs(dx).max())
    assert np.abs(dx).max() > 0.5


@pytest.mark.parametrize("curve", [*LINES, Curve.SPHERE_SILHOUETTE], ids=lambda c: c.name)
def test_no_silhouette_from_inside(variant, curve):
    _, _, _, valid = evaluate(curve, (0.2, 0.3, 0.4, 1.0))
    assert not valid.any()


@pytest.mark.parametrize("plugin", CURVES_OF)
def test_curve_set_covers_every_curve_once(variant, plugin):
    shape = mi.load_dict({"type": plugin})
    rows = curve_set([(shape, plugin), (shape, plugin)]).rows
    assert dr.width(rows.kind) == 2 * PIECES * len(CURVES_OF[plugin])
    for owner in (0, 1):
        for curve in CURVES_OF[plugin]:
            chosen = (np.array(rows.kind) == int(curve)) & (np.array(rows.shape) == owner)
            assert np.allclose(np.sort(np.array(rows.start)[chosen]), np.arange(PIECES) / PIECES)


@pytest.mark.parametrize("plugin", CURVES_OF)
def test_world_points_lie_on_the_shape(variant, plugin):
    """Poses and local viewpoints: the curve in world space lies where the shape itself says its surface is."""
    T = mi.ScalarTransform4f
    shape = mi.load_dict({
        "type": plugin, "to_world": T().translate([0.3, -0.2, 0.5]).rotate([2 / 3, 2 / 3, 1 / 3], 40).scale(0.7)
    })  # fmt: skip
    curves = curve_set([(shape, plugin)])
    columns = curves.poses.at(curves.rows.shape)
    local = local_viewpoint(columns, mi.Vector4f(2, 1, 3, 1))
    p = curve_point(curves.rows.kind, curves.rows.start + 0.3 / PIECES, local)
    eye = np.array(transform_point(columns, mi.Point3f(local.x, local.y, local.z))).T
    assert np.allclose(eye, [2, 1, 3], atol=1e-4)
    x = transform_point(columns, p.x)
    # seen from the eye, or along the normal of a disk, a point just inside of the outline is hit at its distance
    inside = x + 1e-3 * (mi.Point3f(shape.bbox().center()) - x)
    origin = mi.Point3f(2, 1, 3)
    d = inside - origin
    ray = mi.Ray3f(origin, dr.normalize(d))
    si = mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(ray)
    reached = np.array(dr.norm(si.p - x)) < 0.1
    assert reached.mean() > (0.95 if plugin != "cylinder" else 0.4), reached.mean()  # the far rim is hidden


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("curve", list(Curve), ids=lambda c: c.name)
def test_the_own_surface_begins_at_the_curve(variant, curve, view):
    """Just beside every point of a curve lies the surface, and that of a silhouette turns to the viewer."""
    turn, inset = 1e-2, 1e-3
    x, _, outward, _ = evaluate(curve, VIEWS[view])
    c = np.array(VIEWS[view])
    ω = x * c[3] - c[:3]
    ω = ω / np.linalg.norm(ω, axis=1, keepdims=True)
    kind = dr.full(mi.UInt32, int(curve), N)
    own = np.array(own_surface(kind, mi.Point3f(x.T), mi.Vector3f(ω.T), mi.Float(turn), mi.Float(inset))).T
    assert np.abs(np.linalg.norm(own - x, axis=1) - (inset if curve in RIMS else turn)).max() < 1e-4
    radius = np.linalg.norm(own if curve == Curve.SPHERE_SILHOUETTE else own[:, :2], axis=1)
    assert np.allclose(radius, 1 - inset if curve == Curve.DISK_RIM else 1, atol=1e-5)
    assert np.all(np.sum(outward * (own - x), axis=1) < 0)
    if curve not in RIMS:
        n = own if curve == Curve.SPHERE_SILHOUETTE else own * np.array([1, 1, 0])
        assert np.all(np.sum(n * ω, axis=1) < 0)
