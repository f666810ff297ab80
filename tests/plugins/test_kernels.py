"""Kernels are compiled once: neither a seed, nor a budget, nor how many paths touch what moves makes new ones."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.scene import io as scene_io

WARM_UP, CALLS = 4, 12

#: Operations of a kernel from which it follows paths, or does as much.
WALK = 700


@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_later_calls_compile_nothing(llvm, mode, form):
    scene = scene_io.load_scene(scene_io.shipped_scene("baffled_light.xml"), res=16)
    check(scene, mode, form, perturb(scene, "blocker.vertex_positions", (1, 0, 0)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "param"),
    [
        ("rod_shadow", "blocker.control_points"),
        ("painted_curves", "spline.control_points"),
        ("grid_shadow", "blocker.grid"),
        ("grid_shadow", "camera.to_world"),
        ("ellipsoids_shadow", "camera.to_world"),
    ],
)
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_curves_and_grids_compile_nothing_later(llvm, mode, name, param):
    scene = scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), res=16)
    check(scene, mode, "spatial", perturb(scene, param, None if param.endswith("grid") else (1, 0, 0)))


def check(scene: mi.Scene, mode: str, form: str, motion: Perturbation) -> None:
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": form, "sppc": 4})
    compiled, known = [], set()  # by hash: kernels that an earlier process has left on disk count as compiled here
    for seed in range(CALLS):
        spp = 4 + seed % 3  # budgets change as they follow the noise
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            if mode == "forward":
                motion.attach()
                dr.eval(integrator.render_forward(scene, motion.params, seed=seed, spp=spp))
            else:
                θ = mi.Float(0)
                dr.enable_grad(θ)
                motion.params[motion.name] = motion.curve(θ)
                motion.params.update()
                integrator.render_backward(scene, motion.params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=seed, spp=spp)
                assert np.isfinite(float(dr.grad(θ)[0]))
            dr.sync_thread()
            found = {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
            compiled.append(len(found - known))
            known |= found
    motion.restore()
    assert compiled[0] > 0 and not any(compiled[WARM_UP:]), compiled


@pytest.mark.parametrize("budget", ["sppc", "sppp", "spps", "sppd", "sppi"])
def test_a_pose_does_not_repeat_the_walk(llvm, budget):
    """Each entry of a matrix is a sum of its own over all samples: what is summed must have been stored before."""
    scene = scene_io.load_scene(scene_io.shipped_scene("glass.xml"), res=16)
    params, param = mi.traverse(scene), "camera.to_world"
    budgets = {**dict.fromkeys(("sppc", "sppp", "spps", "sppd", "sppi"), 0), budget: 8}
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, "form": "spatial", **budgets})
    dr.enable_grad(params[param])
    params.set_dirty(param)
    params.update()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=0, spp=0)
        dr.sync_thread()
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["operation_count"] > WALK]
    alike = [(k["size"], round(k["operation_count"], -2)) for k in kernels]
    assert all(alike.count(which) < 6 for which in alike), sorted(alike)
