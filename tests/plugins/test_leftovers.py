"""Parameters that a loop of optimisation has left attached to what they were computed from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

import psdr_jit
from psdr_jit.errors import UnsupportedError

MOVER = "blocker.to_world"


def shipped(name: str) -> mi.Scene:
    return mi.load_file(str(psdr_jit.scene_io.shipped_scene(f"{name}.xml")), res=8, optimize=False)


def attach_light(scene: mi.Scene) -> mi.SceneParameters:
    """As an optimisation leaves its pose."""
    params, x = mi.traverse(scene), mi.Float(0.1)
    dr.enable_grad(x)
    params["light.to_world"] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0)) @ params["light.to_world"]
    params.update()
    return params


def detach_light(params: mi.SceneParameters) -> None:
    params["light.to_world"] = dr.detach(params["light.to_world"])
    params.update()


@pytest.mark.parametrize("same", [True, False], ids=["the same scene", "another scene"])
def test_forward_mode_says_what_to_detach(llvm, same):
    """Dr.Jit's calls reach all scenes that are alive. Once it is detached, all is well."""
    scene = shipped("tube_shadow")
    params = attach_light(scene)
    asked = scene if same else shipped("tube_shadow")

    def derivative():
        return psdr_jit.gradient(asked, MOVER, (1, 0, 0), spp=1, seeds=1)

    with pytest.raises(UnsupportedError, match=r"dr\.detach\(params\[key\]\)"):
        derivative()
    detach_light(params)
    derivative()


def test_among_meshes_alone_another_scene_is_no_matter(llvm):
    """Their surfaces are asked for without a call: what is attached in another scene brings nothing."""
    params = attach_light(shipped("cbox"))
    ours = {"type": "psdr_path", "sppc": 16, "sppp": 16, "sppi": 16}
    how = {"direction": (1, 0, 0), "seeds": 1, "integrator": ours}

    def derivative():
        return psdr_jit.gradient(shipped("cbox"), "small-box.vertex_positions", **how).total

    found = derivative()
    detach_light(params)
    expected = derivative()
    assert abs(expected).max() > 0 and abs(found - expected).max() < 1e-4 * abs(expected).max()
