"""Bump and normal maps that turn many normals from the sensor are named, others are not."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from variants import also

from psdr_jit.core.memory import Memory
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene.bent_away import warn_about_bent_normals
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.params import also_enabled

TEXTURES = {"bumpmap": "nested_texture", "normalmap": "normalmap"}

pytestmark = pytest.mark.usefixtures("llvm")


def maps(plugin: str, steepness: float) -> dict:
    """Waves over a sheet."""
    x = np.tile(np.linspace(0, 4 * np.pi, 32, dtype=np.float32), (32, 1))
    if plugin == "bumpmap":
        image, more = np.sin(x)[..., None], {"scale": steepness / (2 * np.pi)}
    else:
        n = np.stack([-steepness * np.cos(x), np.zeros_like(x), np.ones_like(x)], -1)
        image, more = 0.5 + 0.5 * n / np.linalg.norm(n, axis=-1, keepdims=True), {}
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "raw": True}
    return {"type": "twosided", "nested": {"type": plugin, "normalmap": bitmap, "below": {"type": "diffuse"}, **more}}


def is_told(plugin: str, steepness: float, elevation: float, shape: str, param: str, within: bool = False) -> bool:
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    pose = T.rotate([0, 1, 0], elevation).look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 30, "to_world": pose, "film": film}
    body = {"type": shape, "bsdf": maps(plugin, steepness)}
    if within:
        body["bsdf"]["nested"]["below"] = maps(plugin, steepness)["nested"]
    if shape == "sphere":
        body["to_world"] = T.rotate([1, 0, 0], 90)  # waves run towards the rim
    lamp = {"type": "point", "position": [1, 2, 4]}
    description = {"type": "scene", "sky": {"type": "constant"}, "body": body, "lamp": lamp, "sensor": sensor}
    scene = mi.load_dict(description, optimize=False)
    with also_enabled(scene, [param]), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_about_bent_normals(scene, scene.sensors()[0], analyse(scene, scene.sensors()[0]), Memory())
    return any(issubclass(w.category, UnsupportedWarning) and plugin in str(w.message) for w in caught)


@pytest.mark.parametrize("plugin", [also("bumpmap"), "normalmap"])
@pytest.mark.parametrize(("steepness", "elevation", "told"), [(0.3, 60, False), (3.0, 60, True), also(3.0, 0, False)])
def test_steep_maps_are_named_where_they_are_seen_aslant(plugin, steepness, elevation, told):
    """If they are differentiated themselves: no edge moves with a map."""
    assert is_told(plugin, steepness, elevation, "rectangle", f"body.bsdf.brdf_0.{TEXTURES[plugin]}.data") == told


@pytest.mark.parametrize("inner", [also(False), True])
def test_maps_within_maps_are_named_where_they_move(inner):
    """Edges stand for one map."""
    assert is_told("normalmap", 3.0, 60, "rectangle", "body.to_world", inner) == inner


@pytest.mark.parametrize(("steepness", "told"), [(0.05, True), also(0.005, False)])
def test_balls_are_named_where_the_map_changes(steepness, told):
    """Less steep maps turn fewer normals, but always some at a rim."""
    assert is_told("normalmap", steepness, 0, "sphere", "body.bsdf.brdf_0.normalmap.data") == told
