"""B-spline curves: what finite differences of whole scenes (`problems`) do not tell apart."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward

from psdr_jit import make_plan
from psdr_jit.core.tube_axis import Axis
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene.curve_ends import pad_curves

BENT = ((-1.9, -0.6, -0.3, 0.24), (-0.9, 0.1, 0.4, 0.22), (0.1, -0.3, -0.3, 0.16), (0.9, 0.1, 0.3, 0.18),
        (1.6, -0.7, -0.2, 0.22))  # fmt: skip
STRAIGHT = tuple((x, 0, 0, 0.3) for x in (-3, -1, 1, 3))
DIFFUSE = {"type": "twosided", "bsdf": {"type": "diffuse"}}
POINT = {"lamp": {"type": "point", "position": [3, -5, 4], "intensity": 50.0}}

#: Enough for what is said before a ray is traced.
ONE_TERM = {"type": "psdr_path", "form": "spatial", "sppc": 1}


def curve(folder, points, name="tube", **children) -> dict:
    path = folder / f"{name}.txt"
    path.write_text("\n".join(" ".join(map(str, p)) for p in points) + "\n")
    return {"type": "bsplinecurve", "filename": str(path), **children}


def scene_of(**objects) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -6, 1], target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.4]).scale(5)}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor, **POINT, **objects}, optimize=False)


def assert_gain(scene: mi.Scene, param: str, step: float, **how):
    motion, spec = perturb(scene, param, **how), {"type": "psdr_path", "max_depth": 2}
    reference = fd(motion, spec, step, 32, 512)
    slope = gain(forward(motion, spec, 16, 512), reference[0::2], reference[1::2])
    assert slope.stderr < 0.015, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope


@pytest.mark.slow
def test_a_straight_curve_is_a_cylinder(llvm, tmp_path):
    """The same derivative image, up to noise, of a camera that moves across both."""
    spec = {"type": "psdr_path", "max_depth": 2}
    tube = curve(tmp_path, STRAIGHT, bsdf={"type": "diffuse"})
    cylinder = {"type": "cylinder", "p0": [-1, 0, 0], "p1": [1, 0, 0], "radius": 0.3, "bsdf": DIFFUSE}
    images = [forward(perturb(scene_of(tube=shape), "camera.to_world", direction=(0, 0, 1)), spec, 16, 512)
              for shape in (tube, cylinder)]  # fmt: skip
    slope = gain(images[0], images[1][0::2], images[1][1::2])
    assert slope.stderr < 0.01, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope


@pytest.mark.slow
@pytest.mark.parametrize("moved", ["tube", "other"])
def test_two_curves_of_which_one_moves(llvm, tmp_path, moved):
    """Their control points lie in arrays of their own."""
    higher = [(0.8 * x + 0.2, z + 1.5, 0.1 - 1.2 * y, 0.8 * r) for x, y, z, r in BENT]
    scene = scene_of(tube=curve(tmp_path, BENT), other=curve(tmp_path, higher, "other"))
    assert_gain(scene, f"{moved}.control_points", 0.01, direction=(0, 0, 1))


@pytest.mark.slow
def test_a_texture_stays_on_the_curve(llvm, tmp_path):
    u, v = np.meshgrid(np.arange(16) / 16, np.arange(8) / 8)
    waves = 0.5 + 0.4 * np.sin(2 * np.pi * u) * np.cos(2 * np.pi * v)
    bitmap = mi.Bitmap(waves[..., None].astype(np.float32))
    reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"}
    scene = scene_of(tube=curve(tmp_path, BENT, bsdf={"type": "diffuse", "reflectance": reflectance}))
    direction = np.zeros((len(BENT), 4))
    direction[2, :3] = 0.5, 1, 1
    assert_gain(scene, "tube.control_points", 0.01, direction=direction.ravel())


def test_a_curve_in_another_shape_is_named(llvm, tmp_path):
    deep = [(x, y, z - 1.4, r) for x, y, z, r in BENT]
    with pytest.warns(UnsupportedWarning, match="'tube' .bsplinecurve."):
        make_plan(scene_of(tube=curve(tmp_path, deep)), "tube.control_points", integrator=ONE_TERM)


def test_steps_on_a_curve_are_named(llvm, tmp_path):
    heights = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.eye(8, dtype=np.float32)[..., None])}
    tube = curve(tmp_path, BENT, bsdf={"type": "bumpmap", "heights": heights, "bsdf": {"type": "diffuse"}})
    with pytest.warns(UnsupportedWarning, match="bump"):
        make_plan(scene_of(tube=tube), "tube.control_points", integrator=ONE_TERM)


def test_its_outline_is_where_lines_of_sight_are_tangent(llvm):
    points = [mi.Vector4f(*p) for p in BENT[:4]]
    axis = Axis.of(points, dr.linspace(mi.Float, 0, 1, 64))
    eye = mi.Vector3f(0.3, -6, 1)
    for side in (-1, 1):
        ρ, valid = axis.tangent_point(mi.Vector4f(0.3, -6, 1, 1), mi.Float(side))
        assert dr.all(valid)
        cos = dr.dot(dr.normalize(axis.normal(ρ)), dr.normalize(eye - axis.c - ρ))
        assert dr.all(dr.abs(cos) < 1e-4)
        assert dr.allclose(dr.norm(ρ), axis.r, rtol=1e-5) and dr.all(dr.abs(dr.dot(ρ, axis.dc)) < 1e-5)


def test_padded_curves_look_the_same(llvm, tmp_path):
    """What lies behind the segments is changed, nothing that is seen."""
    scene = scene_of(tube=curve(tmp_path, BENT))
    before = np.array(mi.render(scene, spp=16, integrator=mi.load_dict({"type": "direct"})))
    pad_curves(scene)
    after = np.array(mi.render(scene, spp=16, integrator=mi.load_dict({"type": "direct"})))
    assert np.allclose(before, after)
