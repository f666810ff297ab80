"""What is painted is known, and painted lights that Mitsuba samples wrongly are named, and no others."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.memory import Memory
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.painted_lights import warn_about_painted_lights

PAINTED, COLOURED = {"type": "checkerboard"}, {"type": "mesh_attribute", "name": "vertex_color"}
CASES = {"cube-painted": ("cube", PAINTED, True), "cube-plain": ("cube", 1.0, False),
         "cube-coloured": ("cube", COLOURED, True),
         "rectangle-painted": ("rectangle", PAINTED, False), "sphere-painted": ("sphere", PAINTED, False)}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_who_is_named(llvm, case):
    kind, radiance, named = CASES[case]
    scene = mi.load_dict({"type": "scene", "lamp": {"type": kind, "emitter": {"type": "area", "radiance": radiance}},
                          "camera": {"type": "perspective"}})  # fmt: skip
    memory, said = Memory(), []
    for _ in range(2):  # the second time it is known, and has been said
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            warn_about_painted_lights(scene, analyse(scene), memory)
        said.append([str(w.message) for w in found])
    assert [len(texts) for texts in said] == [int(named), 0]
    assert all("'lamp'" in text for text in said[0])


def bitmap() -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32)), "raw": True}


@pytest.mark.parametrize("texture, painted", [
    pytest.param(lambda: PAINTED, True, id="checkerboard"),
    pytest.param(bitmap, True, id="bitmap"),
    pytest.param(lambda: COLOURED, True, id="mesh_attribute"),
    pytest.param(lambda: {"type": "rgb", "value": 0.5}, False, id="rgb"),
])  # fmt: skip
def test_painted_surfaces(llvm, texture, painted):
    """Neither flags of BSDFs nor textures that are attributes say so in Mitsuba 3.9."""
    bsdf = {"type": "twosided", "of": {"type": "diffuse", "reflectance": texture()}}
    thing = {"type": "cube", "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "thing": thing, "camera": {"type": "perspective"}})
    assert analyse(scene).shapes[0].painted == painted
