"""Bump and normal maps that turn many normals from the sensor are named, others are not."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

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


@pytest.mark.parametrize("plugin", ["bumpmap", "normalmap"])
@pytest.mark.parametrize(("steepness", "elevation", "told"), [(0.3, 60, False), (3.0, 60, True), (3.0, 0, False)])
def test_steep_maps_are_named_where_they_are_seen_aslant(plugin, steepness, elevation, told):
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    pose = T.rotate([0, 1, 0], elevation).look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 30, "to_world": pose, "film": film}
    sheet = {"type": "rectangle", "bsdf": maps(plugin, steepness)}
    description = {"type": "scene", "sky": {"type": "constant"}, "sheet": sheet, "sensor": sensor}
    scene, spec = mi.load_dict(description, optimize=False), {"type": "psdr_path", "max_depth": 2}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        psdr_jit.gradient(scene, "sheet.to_world", (1, 0, 0), integrator=spec, spp=1, seeds=2)
    found = [w for w in caught if issubclass(w.category, UnsupportedWarning) and plugin in str(w.message)]
    assert bool(found) == told
