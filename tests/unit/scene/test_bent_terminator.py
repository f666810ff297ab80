"""Maps that do not fade out what they send at grazing light are told from those that do."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.memory import Memory
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene.bent_normals import bent_maps
from psdr_jit.scene.bent_terminator import ends_in_a_step, warn_about_terminators
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.params import also_enabled

pytestmark = pytest.mark.usefixtures("llvm")

BELOW = {
    "diffuse": {"type": "diffuse"},
    "metal": {"type": "roughconductor", "alpha": 0.3},
    "plastic": {"type": "roughplastic", "alpha": 0.2},
}


def below_map(plugin: str, fades: bool, nested: dict, steep: float = 0.3) -> dict:
    rng = np.random.default_rng(1)
    if plugin == "bumpmap":
        image, more = rng.random((8, 8, 1)) * steep, {"scale": 3.0}
    else:
        image, more = 0.5 + 0.5 * np.concatenate([steep * rng.uniform(-1, 1, (8, 8, 2)), np.ones((8, 8, 1))], -1), {}
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "raw": True}
    return {"type": plugin, "normalmap": picture, "use_shadowing_function": fades, "bsdf": nested, **more}


@pytest.mark.parametrize("nested", BELOW.values(), ids=BELOW)
@pytest.mark.parametrize("plugin", ["bumpmap", "normalmap"])
@pytest.mark.parametrize("fades", [True, False])
def test_they_are_told_apart(plugin, fades, nested):
    (bent,) = bent_maps(mi.load_dict(below_map(plugin, fades, nested)))
    assert ends_in_a_step(bent) != fades


def test_a_flat_map_sends_no_more():
    (bent,) = bent_maps(mi.load_dict(below_map("normalmap", False, BELOW["diffuse"], steep=0)))
    assert not ends_in_a_step(bent)


@pytest.mark.parametrize("param, told", [("ball.to_world", True), ("ball.bsdf.nested_bsdf.reflectance.value", False)])
def test_they_are_named_if_something_moves(param, told):
    ball = {"type": "sphere", "bsdf": below_map("normalmap", False, BELOW["diffuse"])}
    scene = mi.load_dict({"type": "scene", "ball": ball, "camera": {"type": "perspective"}}, optimize=False)
    with also_enabled(scene, [param]), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_about_terminators(scene, analyse(scene, scene.sensors()[0]), Memory())
    assert told == any(issubclass(w.category, UnsupportedWarning) and "'ball'" in str(w.message) for w in caught)
