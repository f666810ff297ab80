"""Edges of shapes that rest are kept from call to call, and looked at again when a mesh is written to."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.derivative import integrator_specs
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.params import also_enabled


def edges_of(scene, integrator):
    with also_enabled(scene, ["camera.to_world"]):
        job = prepare(integrator.call(scene, scene.sensors()[0], 0, 4)).jobs[0][1]
        return scene_edges(job).kinds[0]


def test_they_are_kept_and_renewed(llvm):
    scene = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=16)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    first, again = edges_of(scene, integrator), edges_of(scene, integrator)
    assert first.rows.p0.x.index == again.rows.p0.x.index  # the same arrays
    params = mi.traverse(scene)
    moved = params["blocker.vertex_positions"] + 0.25
    params["blocker.vertex_positions"] = moved
    params.update()
    renewed = edges_of(scene, integrator)
    shift = np.array(renewed.rows.p0).max() - np.array(first.rows.p0).max()
    assert renewed.rows.p0.x.index != first.rows.p0.x.index
    assert abs(shift) <= 0.25 + 1e-6 and not np.allclose(np.array(renewed.rows.p0), np.array(first.rows.p0))
    fresh = edges_of(scene, integrator_specs.build({"type": "psdr_path", "max_depth": 2}))
    for field in ("p0", "p1", "n0", "n1", "angle", "shell0"):
        a, b = getattr(renewed.rows, field), getattr(fresh.rows, field)
        assert dr.all(a == b, axis=None)
