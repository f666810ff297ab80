"""Edges are kept from call to call and view to view, and looked at again when a mesh is written to."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.params import also_enabled


def edges_of(scene, integrator, enabled="camera.to_world"):
    with also_enabled(scene, [enabled]):
        job = prepare(integrator.call(scene, scene.sensors()[0], 0, 4)).jobs[0][1]
        return scene_edges(job).kinds[0]


@pytest.mark.parametrize("enabled", ["camera.to_world", "blocker.vertex_positions"])
def test_they_are_kept_and_renewed(llvm, enabled):
    scene = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=16)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    first, again = edges_of(scene, integrator, enabled), edges_of(scene, integrator, enabled)
    assert first.rows.p0.x.index == again.rows.p0.x.index  # the same arrays
    params = mi.traverse(scene)
    moved = params["blocker.vertex_positions"] + 0.25
    params["blocker.vertex_positions"] = moved
    params.update()
    renewed = edges_of(scene, integrator, enabled)
    shift = np.array(renewed.rows.p0).max() - np.array(first.rows.p0).max()
    assert renewed.rows.p0.x.index != first.rows.p0.x.index
    assert abs(shift) <= 0.25 + 1e-6 and not np.allclose(np.array(renewed.rows.p0), np.array(first.rows.p0))
    fresh = edges_of(scene, integrator_specs.build({"type": "psdr_path", "max_depth": 2}), enabled)
    for field in ("p0", "p1", "n0", "n1", "angle", "shell0"):
        a, b = getattr(renewed.rows, field), getattr(fresh.rows, field)
        assert dr.all(a == b, axis=None)


def test_what_begins_to_move_is_noticed(llvm):
    scene = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=16)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    assert not dr.any(edges_of(scene, integrator).rows.moves)
    assert dr.any(edges_of(scene, integrator, "blocker.vertex_positions").rows.moves)


def test_views_of_moving_shapes_share_them(llvm):
    """As in a loop over views after one update: fewer kernels from the second view on, the same gradient."""
    scene = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=16)
    spec = {"type": "psdr_path", "max_depth": 2, "form": "spatial", "sppc": 2, "sppp": 2, "sppd": 2, "sppi": 2}
    integrator, name = integrator_specs.build(spec), "blocker.vertex_positions"
    params, kernels, gradients = mi.traverse(scene), [], []
    for fresh in (True, False, False):
        dr.enable_grad(params[name])
        if fresh:
            params.set_dirty(name)
            params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.isolate_grad():
            dr.kernel_history_clear()
            integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=1, spp=2)
            dr.sync_thread()
            kernels.append(len(dr.kernel_history()))
        gradients.append(np.array(dr.grad(params[name])))
        dr.set_grad(params[name], 0)
    assert kernels[1] == kernels[2] < kernels[0], kernels
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-4, atol=1e-4 * np.abs(gradients[0]).max())
