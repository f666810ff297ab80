"""Bump and normal maps that turn many normals from the sensor are named, others are not."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from variants import also

import psdr_jit
from psdr_jit.errors import UnsupportedWarning

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


def is_told(plugin: str, steepness: float, elevation: float, shape: str, param: str) -> bool:
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    pose = T.rotate([0, 1, 0], elevation).look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 30, "to_world": pose, "film": film}
    body = {"type": shape, "bsdf": maps(plugin, steepness)}
    if shape == "sphere":
        body["to_world"] = T.rotate([1, 0, 0], 90)  # waves run towards the rim
    lamp = {"type": "point", "position": [1, 2, 4]}
    description = {"type": "scene", "sky": {"type": "constant"}, "body": body, "lamp": lamp, "sensor": sensor}
    scene, spec = mi.load_dict(description, optimize=False), {"type": "psdr_path", "max_depth": 2}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        direction = None if param.endswith("data") else (1, 0, 0)
        psdr_jit.gradient(scene, param, direction, integrator=spec, spp=1, seeds=2)
    return any(issubclass(w.category, UnsupportedWarning) and plugin in str(w.message) for w in caught)


@pytest.mark.parametrize("plugin", [also("bumpmap"), "normalmap"])
@pytest.mark.parametrize(("steepness", "elevation", "told"), [(0.3, 60, False), (3.0, 60, True), (3.0, 0, False)])
def test_steep_maps_are_named_where_they_are_seen_aslant(plugin, steepness, elevation, told):
    assert is_told(plugin, steepness, elevation, "rectangle", "body.to_world") == told


@pytest.mark.parametrize(("steepness", "param", "told"), [
    (1.0, "body.to_world", True), (1.0, "sensor.to_world", True), (1.0, "lamp.position", False),
    (0.05, "body.to_world", True), (0.005, "body.to_world", False),
])  # fmt: skip
def test_balls_are_named_where_their_rims_move(steepness, param, told):
    """Less steep maps turn fewer normals, but always some at a rim: with .3, the derivative was 2 to 4 % off."""
    assert is_told("normalmap", steepness, 0, "sphere", param) == told
