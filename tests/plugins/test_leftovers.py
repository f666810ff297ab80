"""Parameters that a loop of optimisation has left attached to what they were computed from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

import psdr_jit
from psdr_jit.errors import UnsupportedError


def cbox() -> mi.Scene:
    return mi.load_file(str(psdr_jit.scene_io.shipped_scene("cbox.xml")), res=8, optimize=False)


@pytest.mark.parametrize("same", [True, False], ids=["the same scene", "another scene"])
def test_forward_mode_says_what_to_detach(llvm, same):
    """Dr.Jit's calls reach all scenes that are alive. Once it is detached, all is well."""
    scene = cbox()
    params = mi.traverse(scene)
    key, x = "light.to_world", mi.Float(0.1)
    dr.enable_grad(x)
    params[key] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0)) @ mi.Transform4f(params[key].matrix)
    params.update()
    asked = scene if same else cbox()

    def derivative():
        return psdr_jit.gradient(asked, "small-box.vertex_positions", (1, 0, 0), spp=1, seeds=1)

    with pytest.raises(UnsupportedError, match=r"dr\.detach\(params\[key\]\)"):
        derivative()
    params[key] = dr.detach(params[key])
    params.update()
    derivative()
