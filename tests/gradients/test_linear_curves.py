"""Linear curves: their geometry, and what finite differences of whole scenes (`problems`) do not tell apart."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward

from psdr_jit import make_plan
from psdr_jit.core.rod import Rod
from psdr_jit.core.rod_crease import crease
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import UnsupportedWarning

ZIGZAG = ((-1.6, -0.3, 0.3, 0.3), (-0.4, 0.2, -0.8, 0.2), (0.5, -0.2, 0.6, 0.32), (1.4, 0.1, -0.4, 0.15))
EYE = (0.3, -6, 1)
VIEW = (*EYE, 1)


def curve(folder, points, **children) -> dict:
    path = folder / "curve.txt"
    path.write_text("\n".join(" ".join(map(str, p)) for p in points) + "\n")
    return {"type": "linearcurve", "filename": str(path), **children}


def scene_of(**objects) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.4]).scale(5)}
    lamp = {"type": "point", "position": [1.5, -2.5, 4], "intensity": 50.0}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor, "lamp": lamp, **objects}, optimize=False)


def rods() -> list[Rod]:
    points = [mi.Vector4f(*p) for p in ZIGZAG]
    return [Rod.between(a, b) for a, b in zip(points[:-1], points[1:], strict=True)]


def test_mitsuba_meets_what_is_modelled(llvm, tmp_path):
    """The points that rays meet lie on a rod, and outside of the others."""
    scene = scene_of(tube=curve(tmp_path, ZIGZAG))
    u = mi.PCG32(20000)
    target = mi.Point3f(u.next_float32() * 4 - 2, u.next_float32() - 0.5, u.next_float32() * 2 - 1)
    ray = mi.Ray3f(mi.Point3f(*EYE), dr.normalize(target - mi.Point3f(*EYE)))
    pi = scene.ray_intersect_preliminary(ray)
    on_curve = np.array(pi.is_valid() & (pi.shape == mi.ShapePtr(scene.shapes()[1])))
    heights = np.stack([np.array(rod.height(ray(pi.t))) for rod in rods()])[:, on_curve]
    assert heights.shape[1] > 1000
    assert np.abs(heights.min(0)).max() < 1e-5
    own = np.array(pi.prim_index)[on_curve]
    assert np.abs(heights[own, np.arange(len(own))]).max() < 1e-5


def test_outlines_are_where_lines_of_sight_are_tangent(llvm):
    t, eye = dr.linspace(mi.Float, 0, 1, 32), mi.Vector3f(*EYE)
    for rod in rods():
        for side in (-1, 1):
            n, valid = rod.side_normal(mi.Vector4f(*VIEW), mi.Float(side))
            x = mi.Point3f(rod.centre(t) + rod.radius(t) * n)
            assert dr.all(valid) and dr.all(dr.abs(rod.height(x)) < 1e-5)
            assert dr.allclose(rod.foot(x), t, atol=1e-5)
            assert dr.all(dr.abs(dr.dot(n, eye - x)) < 1e-5)
        n, dn, valid = rod.end_normal(mi.Vector4f(*VIEW), mi.Float(1), t)
        assert dr.all(valid) and dr.all(dr.abs(dr.dot(n, eye - rod.centre(1) - rod.radius(1) * n)) < 1e-5)
        assert dr.all(dr.abs(dr.dot(n, dn)) < 1e-5)


def test_creases_lie_on_both_rods(llvm):
    t = dr.linspace(mi.Float, 0.01, 0.99, 32)
    for a, b in zip(rods()[:-1], rods()[1:], strict=True):
        x, dx, valid = crease(a.centre(1), a.radius(1), [a, b], [-1.0, 1.0], t)
        assert dr.all(valid)
        for rod in (a, b):
            assert dr.all(dr.abs(rod.height(x)) < 1e-5)
            assert dr.all(dr.abs(dr.dot(rod.place(x)[1], dx)) < 1e-4)
        assert dr.all(a.foot(x) < 1) and dr.all(b.foot(x) > 0)


def test_a_straight_joint_of_even_radius_has_no_crease(llvm):
    points = [mi.Vector4f(x, 0, 0, 0.2) for x in (-1, 0, 1)]
    a, b = Rod.between(*points[:2]), Rod.between(*points[1:])
    assert not dr.any(crease(a.centre(1), a.radius(1), [a, b], [-1.0, 1.0], dr.linspace(mi.Float, 0, 1, 9))[2])


def test_a_waist_is_a_crease_all_around(llvm):
    points = [mi.Vector4f(x, 0, 0, r) for x, r in ((-1, 0.4), (0, 0.2), (1, 0.4))]
    a, b = Rod.between(*points[:2]), Rod.between(*points[1:])
    x, _, valid = crease(a.centre(1), a.radius(1), [a, b], [-1.0, 1.0], dr.linspace(mi.Float, 0, 1, 9))
    assert dr.all(valid) and dr.all(dr.abs(x.x) < 1e-5)


def test_a_curve_in_another_shape_is_named(llvm, tmp_path):
    deep = [(x, y, z - 1.4, r) for x, y, z, r in ZIGZAG]
    with pytest.warns(UnsupportedWarning, match="'tube' .linearcurve."):
        make_plan(scene_of(tube=curve(tmp_path, deep)), "tube.control_points",
                  integrator={"type": "psdr_path", "form": "spatial", "sppc": 1})  # fmt: skip


def test_its_points_are_not_followed(llvm, tmp_path):
    plan = make_plan(scene_of(tube=curve(tmp_path, ZIGZAG)), "tube.control_points",
                     integrator={"type": "psdr_path", "form": "material", "sppc": 1, "max_depth": 4})  # fmt: skip
    assert plan.form == "spatial" and "'tube'" in plan.form_reason


@pytest.mark.slow
def test_a_texture_stays_on_the_curve(llvm, tmp_path):
    u, v = np.meshgrid(np.arange(16) / 16, np.arange(8) / 8)
    waves = 0.5 + 0.4 * np.sin(2 * np.pi * u) * np.cos(2 * np.pi * v)
    bitmap = mi.Bitmap(waves[..., None].astype(np.float32))
    reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"}
    tube = curve(tmp_path, ZIGZAG[1:3], bsdf={"type": "diffuse", "reflectance": reflectance})
    motion = perturb(scene_of(tube=tube), "tube.control_points", direction=[0, 0.5, 0.6, 0, 0.2, 0, -0.3, 0.1])
    spec = {"type": "psdr_path", "max_depth": 2}
    reference = fd(motion, spec, 0.01, 32, 512)
    slope = gain(forward(motion, spec, 16, 512), reference[0::2], reference[1::2])
    assert slope.stderr < 0.015, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope
