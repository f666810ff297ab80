"""Edges are found once for what holds the same numbers, however often these are assigned."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from psdr_jit.edges.scene_table import STRAIGHT
from psdr_jit.scene import io as scene_io

BOX = "small-box.vertex_positions"

pytestmark = pytest.mark.usefixtures("llvm")


def test_edges_are_kept_while_assigned_positions_are_the_same():
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "psdr_path", "max_depth": 3})
    base = mi.Float(params[BOX])

    def edges(shift: float):
        value = base + shift
        dr.enable_grad(value)
        params[BOX] = value
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=4), axis=None))
        return integrator.memory[STRAIGHT][2]

    first = edges(0.0)
    assert edges(0.0) is first
    moved = edges(0.01)
    assert moved is not first
    assert dr.max(dr.abs(moved.rows.p0.x - first.rows.p0.x))[0] == pytest.approx(0.01, rel=1e-3)
