"""Verdicts on parameters, and curves through them: tangent, exact value, and the way back."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from variants import activate

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import ParameterError
from psdr_jit.scene.params import differentiable_params, find_param

EPS = 1e-2


@pytest.fixture(scope="module")
def scene():
    activate("llvm_ad_rgb")
    T = mi.ScalarTransform4f
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.5, dtype=np.float32))}
    return mi.load_dict({
        "type": "scene",
        "cam": {"type": "perspective", "fov": 40, "to_world": T().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "lamp": {"type": "point", "position": [0, 1, 0]},
        "sun": {"type": "directional", "direction": [0, -1, 0]},
        "panel": {"type": "rectangle", "to_world": T().translate([1, 2, 3]),
                  "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}},
        "ball": {"type": "sphere", "bsdf": {"type": "dielectric"}},
        "box": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture}},
    }, optimize=False)


def numbers(value) -> np.ndarray:
    """Any parameter value as a flat array."""
    return np.array(value.matrix if hasattr(value, "matrix") else value, dtype=float).ravel()


def tangent(value) -> np.ndarray:
    return np.array(dr.grad(value.matrix if hasattr(value, "matrix") else value), dtype=float).ravel()


@pytest.mark.parametrize("name, kind, shape", [
    ("cam.to_world", "camera", (4, 4)),           # Mitsuba flags this one as not differentiable
    ("cam.x_fov", "camera", (1,)),
    ("lamp.position", "emitter", (3,)),
    ("sun.to_world", "emitter", (4, 4)),
    ("panel.to_world", "geometry", (4, 4)),
    ("panel.emitter.radiance.value", "emitter", (3,)),
    ("box.vertex_positions", "geometry", (72,)),
    ("box.bsdf.reflectance.data", "texture", (4, 4, 3)),
])
def test_differentiable(scene, name, kind, shape):
    info = find_param(scene, name)
    assert info.differentiable and info.kind == kind and info.shape == shape


@pytest.mark.parametrize("name, reason", [
    ("cam.near_clip", "plain Python float"),
    ("ball.bsdf.eta", "plain Python float, which Dr.Jit does not track; 'psdr_dielectric' is the same"),
    ("cam.film.size", "pixel grid"),
    ("box.faces", "whole numbers"),
    ("box.bsdf.reflectance.to_uv", "host-side constant"),
])
def test_not_differentiable_says_why(scene, name, reason):
    info = {i.name: i for i in differentiable_params(scene)}[name]
    assert not info.differentiable and reason in info.reason
    with pytest.raises(ParameterError, match=reason):
        perturb(scene, name)


def test_unknown_parameter_suggests_close_names(scene):
    with pytest.raises(ParameterError, match=r"did you mean 'box\.vertex_positions'"):
        find_param(scene, "box.vertex_position")
    with pytest.raises(ParameterError, match=r"panel\.emitter\.radiance\.value"):
        find_param(scene, "radiance.value")
    with pytest.raises(ParameterError, match=r"did you mean 'box\.vertex_positions'"):  # what moves the object
        find_param(scene, "bx")
    with pytest.raises(ParameterError, match=r"of that object there are 'box\.vertex_positions'"):
        find_param(scene, "box")


def test_names_lost_in_merging_are_explained(variant):
    """Two meshes of one material become a nameless one, unless the scene is loaded with optimize=False."""
    cube = {"type": "cube", "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict({"type": "scene", "small": dict(cube), "large": dict(cube)})
    with pytest.raises(ParameterError, match=r"loaded with optimize=False"):
        find_param(scene, "small.vertex_positions")


CURVES = [
    ("box.vertex_positions", dict(direction=(1, 2, 3))),
    ("box.vertex_positions", dict(rotate=(0, 2, 0))),
    ("box.vertex_positions", dict(index=4)),
    ("box.vertex_positions", dict(direction=np.arange(72.0))),
    ("panel.to_world", dict(direction=(0, 0, 1))),
    ("panel.to_world", dict(rotate=(1, 1, 0))),
    ("cam.to_world", dict(rotate=(0, 1, 0))),
    ("lamp.position", dict(direction=(1, 0, 0))),
    ("cam.x_fov", {}),
    ("panel.emitter.radiance.value", dict(direction=(1, 0, 2))),
    ("box.bsdf.reflectance.data", {}),
]


@pytest.mark.parametrize("name, how", CURVES)
def test_tangent_is_the_derivative_of_the_exact_curve(scene, name, how):
    """Compares the two roads that the check compares as well; the error of the difference is O(eps^2)."""
    p = perturb(scene, name, **how)
    before = numbers(p.params[name])
    p.attach()
    slope = tangent(p.params[name])
    p.set_value(EPS)
    above = numbers(p.params[name])
    p.set_value(-EPS)
    below = numbers(p.params[name])
    p.restore()
    assert np.abs(slope).max() > 0.1
    assert np.allclose((above - below) / (2 * EPS), slope, atol=3e-4 * np.abs(slope).max())
    assert np.array_equal(numbers(p.params[name]), before)
    value = p.params[name]
    assert not dr.grad_enabled(value.matrix if hasattr(value, "matrix") else value)


def test_rotation_turns_about_the_bounding_box_centre(scene):
    """A quarter turn of the shifted panel about z maps its local x axis to y and leaves its centre alone."""
    p = perturb(scene, "panel.to_world", rotate=(0, 0, 5))
    p.set_value(np.pi / 2)
    m = np.array(p.params["panel.to_world"].matrix, dtype=float).reshape(4, 4)
    p.restore()
    assert np.allclose(m[:3, 3], [1, 2, 3], atol=1e-5)
    assert np.allclose(m[:3, 0], [0, 1, 0], atol=1e-6)


def test_translation_is_in_world_space(scene):
    """The camera looks along another axis, yet moves along the world's x."""
    p = perturb(scene, "cam.to_world", (1, 0, 0))
    before = np.array(p.params["cam.to_world"].matrix, dtype=float).reshape(4, 4)
    p.set_value(0.5)
    after = np.array(p.params["cam.to_world"].matrix, dtype=float).reshape(4, 4)
    p.restore()
    assert np.allclose((after - before)[:3, 3], [0.5, 0, 0], atol=1e-6)
    assert np.allclose((after - before)[:3, :3], 0)


def test_restore_brings_authored_normals_back(scene):
    """Mitsuba recomputes vertex normals when vertices move; afterwards they are those of the file again."""
    p = perturb(scene, "box.vertex_positions", rotate=(0, 1, 0))
    before = numbers(p.params["box.vertex_normals"])
    p.set_value(0.3)
    assert not np.allclose(numbers(p.params["box.vertex_normals"]), before)
    p.restore()
    assert np.array_equal(numbers(p.params["box.vertex_normals"]), before)


@pytest.mark.parametrize("make", [
    list, tuple, np.array, lambda v: np.array([v]), lambda v: mi.Vector3f(*v), lambda v: mi.ScalarVector3f(*v),
    lambda v: mi.Point3f(*v), lambda v: mi.Normal3f(*v), lambda v: mi.TensorXf(v), lambda v: mi.Float(v),
])  # fmt: skip
@pytest.mark.parametrize("name, way", [("box.vertex_positions", "direction"), ("box.vertex_positions", "rotate"),
                                       ("lamp.position", "direction"), ("panel.emitter.radiance.value", "direction")])
def test_a_direction_may_be_any_kind_of_array(scene, name, way, make):
    expected, found = (perturb(scene, name, **{way: v}) for v in ((1, 0, 2), make([1.0, 0.0, 2.0])))
    assert found.label == expected.label and found.scale == expected.scale
    ends = [numbers(p.curve(mi.Float(0.1))) for p in (expected, found)]
    assert np.array_equal(*ends) and not np.array_equal(ends[0], numbers(found.curve(mi.Float(0))))


def test_a_vector_per_vertex_keeps_its_order(scene):
    """Dr.Jit stores all x first, the parameter x y z of one vertex after the other."""
    flat = np.arange(72.0)
    expected, found = (perturb(scene, "box.vertex_positions", v) for v in (flat, mi.Point3f(flat.reshape(24, 3).T)))
    assert np.array_equal(*(numbers(p.curve(mi.Float(0.1))) for p in (expected, found)))


@pytest.mark.parametrize("name, how, words", [
    ("box.vertex_positions", {}, "needs a direction"),
    ("box.vertex_positions", dict(direction=(1, 0)), "3 numbers"),
    ("box.vertex_positions", dict(direction=(0, 0, 0)), "not all zero"),
    ("box.vertex_positions", dict(direction=(np.nan, 0, 1)), "finite"),
    ("box.vertex_positions", dict(index=72), "outside"),
    ("box.vertex_positions", dict(direction=(1, 0, 0), index=1), "not several"),
    ("panel.to_world", dict(index=1), "is a transform"),
    ("cam.x_fov", dict(rotate=(0, 1, 0)), "cannot be rotated"),
    ("panel.emitter.radiance.value", dict(direction=(1, 2)), "1 or 3 numbers"),
])
def test_bad_directions_name_the_way_out(scene, name, how, words):
    with pytest.raises(ParameterError, match=words):
        perturb(scene, name, **how)
