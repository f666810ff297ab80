"""Scenes, sensors and integrators of another variant, and meshes with nothing in them: errors that name both sides."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from variants import needs_meshes_without_faces

import psdr_jit
from psdr_jit.errors import OptionError, SceneError, UnsupportedError

BOX = "box.vertex_positions"
TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]

pytestmark = pytest.mark.usefixtures("llvm")


def load(**objects) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance"}
    sensor = {"type": "perspective", "film": film}
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 4])}
    return mi.load_dict({"type": "scene", "sensor": sensor, "lamp": {"type": "constant"}, "box": box, **objects},
                        optimize=False)  # fmt: skip


def calls(scene: mi.Scene, name: str = BOX):
    """Every way in."""
    variable, target = psdr_jit.Pose(name, learning_rate=0.1), np.zeros((4, 4, 1))
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    return (
        lambda: psdr_jit.gradient(scene, name, (1, 0, 0), spp=1, seeds=1),
        lambda: psdr_jit.check_gradient(scene, name, (1, 0, 0), spp=1, max_seconds=1),
        lambda: psdr_jit.make_plan(scene, name),
        lambda: psdr_jit.optimize(scene, variable, target, iterations=1, spp=1),
        lambda: integrator.render(scene, spp=1),
        lambda: integrator.render_forward(scene, None, spp=1),
    )


def test_a_scene_of_another_variant():
    scene = load()
    mi.set_variant("llvm_ad_mono")
    for call in (*calls(scene), lambda: psdr_jit.differentiable_params(scene)):
        with pytest.raises(SceneError, match="the scene belongs to variant 'llvm_ad_rgb', but 'llvm_ad_mono' is set"):
            call()


def test_an_integrator_or_sensor_of_another_variant():
    integrator, sensor = mi.load_dict({"type": "psdr_path"}), load().sensors()[0]
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(OptionError, match="the integrator belongs to variant 'llvm_ad_rgb', but 'llvm_ad_mono'"):
        psdr_jit.gradient(load(), BOX, (1, 0, 0), spp=1, integrator=integrator)
    with pytest.raises(SceneError, match="the sensor belongs to variant 'llvm_ad_rgb', but 'llvm_ad_mono'"):
        psdr_jit.gradient(load(), BOX, (1, 0, 0), spp=1, sensor=sensor)


def test_a_variant_without_derivatives():
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError) as caught:  # Mitsuba's loader wraps what we raise
        mi.load_dict({"type": "psdr_path"})
    last = str(caught.value).splitlines()[-1]
    assert last.startswith("UnsupportedError: 'psdr_path' computes derivatives, which variant 'scalar_rgb' does not")
    variable = psdr_jit.Pose(BOX, learning_rate=0.1)
    for call in (lambda: psdr_jit.make_plan(load(), BOX), lambda: psdr_jit.optimize(load(), variable, np.zeros(3))):
        with pytest.raises(UnsupportedError, match="'scalar_rgb' does not track derivatives"):
            call()
    mi.set_variant("llvm_ad_rgb")
    assert isinstance(mi.load_dict({"type": "psdr_path"}), mi.Integrator)


def empty(points: list, faces: list) -> mi.Mesh:
    mesh = mi.Mesh("m", len(points), len(faces))
    params = mi.traverse(mesh)
    if points:
        params["vertex_positions"] = np.array(points, dtype=np.float32).ravel()
    if faces:
        params["faces"] = np.array(faces, dtype=np.uint32).ravel()
    params.update()
    return mesh


@needs_meshes_without_faces
@pytest.mark.parametrize("name", [BOX, "m.vertex_positions"])
@pytest.mark.parametrize(("points", "faces", "words"), [
    ([], [], "no vertices"), ([], [[0, 0, 0]], "no vertices"), (TRIANGLE, [], "no faces"),
])  # fmt: skip
def test_meshes_with_nothing_in_them(points, faces, words, name):
    for call in calls(load(m=empty(points, faces)), name):
        with pytest.raises(SceneError, match=f"mesh 'm' has {words}; remove it or fix its file"):
            call()


def test_a_wrong_property_is_named_without_our_own_frames():
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "psdr_path", "max_depth": "x"})
    lines = str(caught.value).splitlines()
    assert lines[-1].startswith("OptionError: max_depth = 'x' is of type str")
    assert sum("_render.py" in line for line in lines) == 1 and not any("options.py" in line for line in lines)
    with pytest.raises(OptionError, match="integrator 'prb' cannot be made: it has no property 'bogus'"):
        psdr_jit.gradient(load(), BOX, (1, 0, 0), integrator={"type": "prb", "bogus": 1})


@pytest.mark.parametrize("wrong, near", [("max_dept", "'max_depth'"), ("gide", "'guide'"), ("xyz", None)])
def test_a_misspelt_property_is_told_what_it_may_have_meant(wrong, near):
    words = f"psdr_path has no property '{wrong}'" + (f"; did you mean {near}" if near else "$")
    with pytest.raises(OptionError, match=words):
        psdr_jit.gradient(load(), BOX, (1, 0, 0), integrator={"type": "psdr_path", wrong: 1})
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "psdr_path", wrong: 1})
