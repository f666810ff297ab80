"""From which angles between normals and faces on horizons are sampled."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from benchmarks import meshes
from psdr_jit.core.memory import Memory
from psdr_jit.edges.coarse import bent_meshes

GLOSSY = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}}
BLENDED = {"type": "roughplastic", "alpha": 0.1}


@pytest.mark.parametrize("segments, material, matters", [
    (16, {"type": "diffuse"}, True),  # 11 degrees
    (64, {"type": "diffuse"}, False),  # 2.8 degrees
    (64, GLOSSY, True), (64, BLENDED, True), (200, GLOSSY, False),
])  # fmt: skip
def test_glossy_materials_ask_for_more(llvm, segments, material, matters):
    ball = meshes.smooth_mesh("ball", *meshes.ball(segments // 2, segments), mi.load_dict(material))
    assert bent_meshes([ball], Memory()) == [matters]


def test_remembered_until_it_moves(llvm):
    """A ball drawn out into a spindle is bent more."""
    ball = meshes.smooth_mesh("ball", *meshes.ball(32, 64), mi.load_dict({"type": "diffuse"}))
    memory = Memory()
    assert bent_meshes([ball], memory) == [False]
    params = mi.traverse(ball)
    points = np.array(params["vertex_positions"]).reshape(-1, 3) * [1, 1, 0.05]
    params["vertex_positions"] = mi.Float(points.ravel())
    params.update()
    assert bent_meshes([ball], memory) == [True]
