"""The curve on which a face's interpolated normal turns away: closed form, and what its points weigh."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.edges.kind_mirror_horizon import MirroredFace
from psdr_jit.edges.shading_curve import Face

FACES, SAMPLES = 32, 4096
GRID = 1500  # of the midpoint rule over a face, and of the width of the band around the curve
BAND = {Face: 0.01, MirroredFace: 0.003}
ANYWHERE, FAR = (0.4, -0.3, 2.5, 1), (0.36, -0.48, 0.8, 0)


def random_face(rng, bend: float) -> Face:
    """A triangle near the xy plane seen at a slant, with normals that lean by about `bend`."""
    p = rng.normal(size=(3, 3)) * [1, 1, 0.2]
    n = [1, 0, 0] + bend * rng.normal(size=(3, 3))
    return Face([mi.Point3f(*map(float, row)) for row in p], [mi.Normal3f(*map(float, row)) for row in n])


def height(face: Face, b: mi.Point2f, view: mi.Vector4f) -> mi.Float:
    """n·(direction to the viewer), of unit length."""
    towards = mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(face.at(b))
    return dr.dot(face.normal(b), towards) / dr.norm(towards)


def inside_band(face: Face, view: mi.Vector4f) -> float:
    """∫ δ(h) dA over the face, as the area of |h| < BAND divided by 2 BAND."""
    band = BAND[type(face)]
    i = dr.arange(mi.UInt32, GRID * GRID)
    b = mi.warp.square_to_uniform_triangle((mi.Point2f(i % GRID, i // GRID) + 0.5) / GRID)
    return float(dr.mean(dr.select(dr.abs(height(face, b, view)) < band, face.area, 0))[0]) / (2 * band)


@pytest.mark.parametrize("kind", [Face, MirroredFace])
@pytest.mark.parametrize("view", [ANYWHERE, FAR], ids=["viewpoint", "direction"])
def test_its_points_and_what_they_weigh(llvm, view, kind):
    """Points lie on the curve; ∫ weight ds = ∫ δ(h) dA, for faces of which it cuts off any corner, once or more."""
    rng = np.random.default_rng(3)
    view = mi.Vector4f(*view)
    s = (dr.arange(mi.Float, SAMPLES) + 0.5) / SAMPLES
    crossed = 0
    for bend in np.linspace(0.3, 3, FACES):
        plain = random_face(rng, bend)
        face = kind(plain.p, plain.n)
        curve = face.curve(s, view)
        off = dr.select(curve.valid, height(face, curve.b, view), 0)
        assert np.abs(np.array(off)).max() < 1e-3
        weight = dr.select(curve.valid, curve.weight, 0)
        found, expected = float(dr.mean(weight)[0]), inside_band(face, view)
        assert found == pytest.approx(expected, rel=0.05, abs=0.02)
        if found > 0:
            crossed += 1
            assert np.array(face.may_cross(view, mi.Float(0))).all()
    assert crossed > FACES / 4


def test_a_sphere_is_seen_up_to_its_horizon(llvm):
    """Normals n = x of a unit sphere's inscribed face turn away where 1 = o·x."""
    corners = [mi.Point3f(*row) for row in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    face = Face(corners, [mi.Normal3f(p) for p in corners])
    view = mi.Vector4f(3, 0.1, 0.2, 1)
    curve = face.curve((dr.arange(mi.Float, 100) + 0.5) / 100, view)
    x = face.at(curve.b)
    assert np.array(curve.valid).all()
    # n·(o − x) = x·o − x² on the face, whose points are shorter than 1
    assert np.allclose(np.array(dr.dot(x, mi.Vector3f(3, 0.1, 0.2))), np.array(dr.squared_norm(x)), atol=1e-5)


def rise(face: Face, ω: mi.Vector3f, b: mi.Point2f, along: mi.Vector3f) -> mi.Float:
    """Change of n·ω along a vector in the face, by central differences."""
    step = 1e-2 * mi.Point2f(face.barycentric(along))
    return dr.dot(face.normal(b + step) - face.normal(b - step), ω) / 2e-2


@pytest.mark.parametrize("kind", [Face, MirroredFace])
def test_the_gradient_is_that_of_the_height(llvm, kind):
    plain = random_face(np.random.default_rng(5), 1.0)
    face = kind(plain.p, plain.n)
    ω, b = mi.Vector3f(0.36, -0.48, 0.8), mi.Point2f(0.2, 0.5)
    along = face.sides[0] * 0.3 + face.sides[1] * 0.7
    assert np.allclose(np.array(dr.dot(face.gradient(ω, b), along)), np.array(rise(face, ω, b, along)), rtol=1e-3)


def test_its_norm_is_that_of_all_components(llvm):
    face, b = random_face(np.random.default_rng(5), 1.0), mi.Point2f(0.2, 0.5)
    axes = [mi.Vector3f(*row) for row in np.eye(3).tolist()]
    total = np.sqrt(sum(np.array(dr.squared_norm(face.gradient(axis, b))) for axis in axes))
    assert np.allclose(np.array(face.gradient_norm), total, rtol=1e-5)


def test_horizons_are_where_mirrors_reflect_along_the_face(llvm):
    face = random_face(np.random.default_rng(7), 0.5)
    b, n = mi.Point2f(0.3, 0.4), dr.normalize(face.n_g)
    M, n_s = MirroredFace(face.p, face.n).normal(b), dr.normalize(face.normal(b))
    for u in np.linspace(0, 1, 7).tolist():
        sin, cos = dr.sincos(mi.Float(2 * np.pi * u))
        s, t = mi.coordinate_system(dr.normalize(M))
        ω = cos * s + sin * t
        assert abs(float(dr.dot(n, ω - 2 * dr.dot(n_s, ω) * n_s)[0])) < 1e-5
