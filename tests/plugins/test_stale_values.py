"""A loop that does not assign its parameter loses the derivative of recomputed normals: it is told, others are not."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene import io as scene_io

BALL = "ball.vertex_positions"
WORDS = r"vertex normals of shape 'ball' do not depend on 'ball\.vertex_positions'.*params\.set_dirty"

pytestmark = pytest.mark.usefixtures("llvm")


def load():
    scene = scene_io.load_scene(scene_io.shipped_scene("smooth_mesh.xml"), res=8)
    return scene, mi.traverse(scene)


def integrator():
    return mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4})


def backward(scene, params, method, seed: int = 0) -> np.ndarray:
    """The gradient, which does not add up over calls."""
    dr.set_grad(params[BALL], 0)
    image = mi.render(scene, params, integrator=method, spp=4, seed=seed)
    dr.backward(dr.mean(dr.square(image), axis=None))
    return np.array(dr.grad(params[BALL]))


def test_a_second_pass_without_assignment_is_told_and_set_dirty_mends_it():
    scene, params = load()
    method = integrator()

    def one_pass(mended: bool) -> np.ndarray:
        dr.enable_grad(params[BALL])
        if mended:
            params.set_dirty(BALL)
        params.update()
        return backward(scene, params, method)

    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        whole = one_pass(mended=False)
    with pytest.warns(UnsupportedWarning, match=WORDS):
        part = one_pass(mended=False)
    assert not np.allclose(part, whole, atol=0.1 * np.abs(whole).max())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        assert np.allclose(one_pass(mended=True), whole, atol=1e-4 * np.abs(whole).max())


def test_a_parameter_that_was_not_updated_is_told():
    scene, params = load()
    dr.enable_grad(params[BALL])
    with pytest.warns(UnsupportedWarning, match=WORDS):
        backward(scene, params, integrator())


@pytest.mark.filterwarnings("error::psdr_jit.errors.UnsupportedWarning")
def test_loops_that_assign_or_isolate_are_not_told():
    scene, params = load()
    method = integrator()
    optimizer = mi.ad.Adam(lr=1e-3)
    optimizer[BALL] = params[BALL]
    for seed in range(3):
        params.update(optimizer)
        backward(scene, params, method, seed)
        optimizer.step()
    params.update(optimizer)
    with dr.isolate_grad():
        for seed in range(2):
            backward(scene, params, method, seed)
    variable = psdr_jit.Vertices(BALL, learning_rate=1e-3, smoothness=0)
    psdr_jit.optimize(scene, variable, np.zeros((8, 8, 3)), iterations=2, spp=2, integrator=method)


def field_of_view(updated: bool, seed: int = 0) -> float:
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)
    params = mi.traverse(scene)
    dr.enable_grad(params["sensor.x_fov"])
    if updated:
        params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=integrator(), spp=4, seed=seed), axis=None))
    return float(dr.grad(params["sensor.x_fov"])[0])


def test_a_field_of_view_that_was_not_updated_is_told():
    with pytest.warns(UnsupportedWarning, match=r"does not depend on 'sensor\.x_fov'.*params\.update"):
        assert field_of_view(updated=False) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        assert field_of_view(updated=True) != 0


@pytest.mark.filterwarnings("error::psdr_jit.errors.UnsupportedWarning")
@pytest.mark.parametrize("key", ["floor.to_world", "sensor.to_world"])
def test_poses_that_are_assigned_or_read_as_they_are_are_not_told(key: str):
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)
    params = mi.traverse(scene)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    params[key] = mi.Transform4f().translate([shift, 0, 0]) @ mi.Transform4f(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=integrator(), spp=4), axis=None))
    assert dr.grad(shift)[0] != 0


@pytest.mark.filterwarnings("error::psdr_jit.errors.UnsupportedWarning")
def test_a_sensor_that_was_loaded_by_itself_is_not_taken_for_the_scene_s():
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)
    view = {"type": "perspective", "fov": 40, "film": {"type": "hdrfilm", "width": 8, "height": 8},
            "to_world": mi.ScalarTransform4f().look_at([0, 1, 4], [0, 1, 0], [0, 1, 0])}  # fmt: skip
    sensor = mi.load_dict(view)
    params = mi.traverse(sensor)
    dr.enable_grad(params["x_fov"])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, sensor=sensor, integrator=integrator(), spp=4), axis=None))
    assert dr.grad(params["x_fov"])[0] != 0
