"""Poses that Mitsuba does not render as they say are named where they matter: mirrored spheres, scaled skies."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.errors import SceneError, UnsupportedWarning
from psdr_jit.scene.checks import findings
from psdr_jit.scene.facts import analyse

pytestmark = pytest.mark.usefixtures("llvm")


def complaints(name: str, **objects) -> list[tuple[type, str]]:
    """What is found where `name` is differentiated."""
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, **objects}, optimize=False)
    params = mi.traverse(scene)
    value = params[name]
    dr.enable_grad(value if dr.is_array_v(value) else value.matrix)
    params.update()
    return [(finding.category, finding.subject) for finding in findings(analyse(scene, 0))]


@pytest.mark.parametrize("plugin", ["sphere", "cylinder"])
@pytest.mark.parametrize(("scale", "name", "told"), [
    ([-1, 1, 1], "x.to_world", True), ([-1, -1, 1], "x.to_world", False), ([-1, 1, 1], "sensor.to_world", False),
    ([-1, 1, 1], "x.bsdf.reflectance.value", False),
])  # fmt: skip
def test_mirrored_shapes_that_move(plugin, scale, name, told):
    """Their normals are turned over whenever they are updated: those that rest keep them."""
    shape = {"type": plugin, "to_world": mi.ScalarTransform4f().scale(scale), "bsdf": {"type": "diffuse"}}
    assert ((SceneError, "x") in complaints(name, x=shape)) == told


SKIES = {
    "envmap": lambda: {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))},
    "sunsky": lambda: {"type": "sunsky"},
}


@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize(("pose", "told"), [
    (("rotate", [1, 1, 0], 50), True), (("scale", 2), True), (("rotate", [0, 0.6, 0.8], 50), False),
    (("scale", [-1, 1, 1]), False),
])  # fmt: skip
def test_skies_that_are_more_than_turned(sky, pose, told):
    """An axis of rotation that is not of length 1 is what people write: Mitsuba makes a shear of it."""
    how, *arguments = pose
    turned = SKIES[sky]() | {"to_world": getattr(mi.ScalarTransform4f(), how)(*arguments)}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
    found = complaints("floor.bsdf.reflectance.value", env=turned, floor=floor)
    assert ((UnsupportedWarning, "env") in found) == told


@pytest.mark.parametrize("plugin", ["disk", "instance", "rectangle"])
@pytest.mark.parametrize(("axis", "told"), [([0, 1, 1], True), ([0, 0.6, 0.8], False)])
def test_rotations_about_long_axes(plugin, axis, told):
    """Mitsuba takes the transpose for the inverse. Rays meet meshes, and rectangles, where they are all the same."""
    objects = {"x": {"type": plugin, "to_world": mi.ScalarTransform4f().translate([1e3, 0, 0]).rotate(axis, 50)}}
    if plugin == "instance":
        objects["x"]["g"] = {"type": "ref", "id": "g"}
        objects = {"g": {"type": "shapegroup", "box": {"type": "cube"}}} | objects
    assert ((SceneError, "x") in complaints("sensor.to_world", **objects)) == (told and plugin != "rectangle")


@pytest.mark.parametrize(("name", "category"), [("ball.to_world", SceneError), ("sky.to_world", UnsupportedWarning)])
def test_several_poses_are_named(name, category):
    """As variables that are wider than one make them."""
    bodies = {"ball": {"type": "sphere"}, "sky": SKIES["envmap"](), "camera": {"type": "perspective"}}
    scene = mi.load_dict({"type": "scene", **bodies})
    params, x = mi.traverse(scene), dr.linspace(mi.Float, 0, 1, 5)
    dr.enable_grad(x)
    params[name] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0))
    params.update()
    found = findings(analyse(scene, 0))
    assert [f.category for f in found if "several matrices" in f.message] == [category]
