"""Directions around an edge: the density is the one that is sampled, integrates to one, and covers what can matter."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

COUNT = 1 << 15
FOUR_PI = 4 * np.pi


def rows(shape: str):
    from psdr_jit.core.memory import Memory
    from psdr_jit.edges.segments import edge_set

    to_world = mi.ScalarTransform4f().rotate([1, 2, 3], 40).scale([1, 2, 0.5])
    mesh = mi.load_dict({"type": shape, "to_world": to_world})
    return edge_set([mesh], [True], Memory()).rows


def lanes(values, index: int):
    return dr.gather(type(values), values, dr.full(mi.UInt32, index, COUNT))


@pytest.mark.parametrize("shape", ["cube", "rectangle"])
def test_density_is_what_is_sampled(variant, shape):
    from psdr_jit.edges.wedges import step_wedges

    table = rows(shape)
    rng = np.random.default_rng(0)
    sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.random(COUNT), rng.random(COUNT)))
    # the lune of a coplanar edge is as thin as rounding
    matters = np.array((step_wedges(table).measure > 0) & (table.angle > 1e-3))
    assert matters.sum() == (12 if shape == "cube" else 4)
    for index in np.flatnonzero(matters):
        edge = lanes(table, int(index))
        w = step_wedges(edge)
        ω, pdf = w.sample(mi.Point2f(rng.random(COUNT), rng.random(COUNT)))
        assert np.allclose(np.array(dr.norm(ω)), 1, atol=1e-5)
        agree = np.isclose(np.array(w.pdf(ω)), np.array(pdf), rtol=1e-4)
        assert agree.mean() > 0.999  # rounding may put a sample on the other side of a wedge's border
        mass = np.array(w.pdf(sphere)) * FOUR_PI
        assert abs(mass.mean() - 1) <= 6 * mass.std() / np.sqrt(COUNT) + 1e-5


def test_a_closed_box_is_not_looked_at_from_inside(variant):
    """Directions in which both faces of a convex edge show their backs are never drawn."""
    from psdr_jit.edges.wedges import step_wedges

    table = rows("cube")
    rng = np.random.default_rng(1)
    index = int(np.flatnonzero(np.array((step_wedges(table).measure > 0) & (table.angle > 1e-3)))[0])
    edge = lanes(table, index)
    ω, _ = step_wedges(edge).sample(mi.Point2f(rng.random(COUNT), rng.random(COUNT)))
    front0, front1 = np.array(dr.dot(edge.n0, -ω)) > -1e-5, np.array(dr.dot(edge.n1, -ω)) > -1e-5
    assert (front0 | front1).all() and (front0 & front1).any() and (front0 ^ front1).any()


@pytest.mark.parametrize("ahead", [0.0, 0.5])
@pytest.mark.parametrize("distance", [0.5, 3.0, 300.0])
def test_the_mixture_of_a_resting_edge(variant, distance, ahead):
    """The density of `sample_view` integrates to one, by importance sampling with itself and with its parts."""
    from psdr_jit.core.cones import towards_sphere
    from psdr_jit.edges.wedges import silhouette_wedges
    from psdr_jit.sampling.directions import pdf_view, sample_view

    rng = np.random.default_rng(2)
    edge = lanes(rows("cube"), 0)
    cone = towards_sphere(edge.p0, edge.p0 + mi.Vector3f(0.6, 0.8, 0) * distance, mi.Float(1))
    rests = mi.Bool(rng.random(COUNT) < 0.5)
    w = silhouette_wedges(edge)
    ω, pdf = sample_view(w, cone, rests, ahead, mi.Point2f(rng.random(COUNT), rng.random(COUNT)))
    assert np.allclose(np.array(dr.norm(ω)), 1, atol=1e-5)
    assert np.array(pdf > 0).mean() > 0.999
    # 1 / pdf integrates the measure of the density's support: the lune, and for resting edges the cone as well
    support = np.array(cone.open)[0] * 2 * np.pi
    for d in (-ω, ω) if ahead else (-ω,):
        inside = np.array(cone.pdf(d) > 0) & np.array(rests)
        found = (inside / np.array(pdf)).sum() / np.array(rests).sum()
        assert found == pytest.approx(support, rel=0.05)
    assert np.allclose(np.array(pdf_view(w, cone, rests, ahead, ω)), np.array(pdf))


def test_cone(variant):
    from psdr_jit.core.cones import towards_sphere

    rng = np.random.default_rng(3)
    x, centre = mi.Point3f(1, 2, 3), mi.Point3f(4, -2, 3)
    cone = towards_sphere(x, centre, mi.Float(2.5))
    d = cone.sample(mi.Point2f(rng.random(COUNT), rng.random(COUNT)))
    assert np.array(cone.pdf(d) > 0).mean() > 0.999
    away = np.array(dr.norm(centre - x - d * dr.dot(d, centre - x)))
    assert away.max() == pytest.approx(2.5, rel=1e-3) and away.max() < 2.5 + 1e-4
    assert float(cone.share[0]) == pytest.approx((1 - np.sqrt(1 - 0.25)) / 2, rel=1e-5)
    inside = towards_sphere(x, centre, mi.Float(6))
    assert float(inside.share[0]) == 1
