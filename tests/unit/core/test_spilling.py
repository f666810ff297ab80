"""Shared memory for registers: not on CUDA, where kernels with function calls are refused with it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from psdr_jit.core.spilling import spill_to_local_memory
from psdr_jit.scene import io as scene_io


@pytest.mark.parametrize(("name", "stays"), [("cuda_ad_rgb", False), ("llvm_ad_rgb", True)])
def test_it_is_switched_off_on_cuda(monkeypatch, name, stays):
    monkeypatch.setattr(mi, "variant", lambda: name)
    with dr.scoped_set_flag(dr.JitFlag.SpillToSharedMemory, True):
        spill_to_local_memory()
        assert dr.flag(dr.JitFlag.SpillToSharedMemory) == stays


@pytest.mark.parametrize("mode", ["primal", "forward"])
def test_every_call_does_so(llvm, monkeypatch, mode):
    from psdr_jit.plugins import _render

    seen = []
    monkeypatch.setattr(_render, "spill_to_local_memory", lambda: seen.append(True))
    scene = scene_io.load_scene(scene_io.shipped_scene("emissive_card.xml"), res=8)
    integrator = mi.load_dict({"type": "psdr_path"})
    if mode == "primal":
        mi.render(scene, integrator=integrator, spp=1)
    else:
        params = mi.traverse(scene)
        dr.enable_grad(params["card.vertex_positions"])
        params.update()
        integrator.render_forward(scene, params, spp=1)
    assert seen


def test_a_scene_of_which_a_kernel_was_refused(variant):
    """Its interior term looks at emitters in a kernel without rays, which spills."""
    scene = scene_io.load_scene(scene_io.shipped_scene("half_plane.xml"), res=64, rfilter="gaussian")
    params = mi.traverse(scene)
    dr.enable_grad(params["plane.vertex_positions"])
    params.update()
    image = mi.load_dict({"type": "psdr_path", "max_depth": 2}).render_forward(scene, params, spp=64)
    assert dr.all(dr.isfinite(image), axis=None)
