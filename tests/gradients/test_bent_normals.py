"""Shadows on surfaces whose normals are bent by a picture: the cosine of the light is that in the bent frame."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import assert_grad_close, fd, forward
from test_light_steps import box, pose, scene_of, wall

from psdr_jit.derivative.perturbation import perturb

SIDE = 4  # texels of the picture


def bump() -> dict:
    heights = mi.Bitmap(np.random.default_rng(1).random((SIDE, SIDE, 1)).astype(np.float32))
    picture = {"type": "bitmap", "bitmap": heights, "raw": True}
    return {"type": "bumpmap", "heights": picture, "scale": 1.2, "of": {"type": "diffuse"}}


def normals() -> dict:
    bent = np.random.default_rng(2).uniform(0.2, 0.8, (SIDE, SIDE, 3)).astype(np.float32)
    bent[..., 2] = 0.9
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(bent), "raw": True}
    return {"type": "normalmap", "normalmap": picture, "of": {"type": "diffuse"}}


@pytest.mark.slow
@pytest.mark.parametrize("depth", [2, 3])
@pytest.mark.parametrize("floor", [bump, normals])
def test_shadows_of_a_box(llvm, floor, depth):
    """At depth 3 also those that a wall lights, which the sensor sees by way of the floor."""
    lamp = {"type": "point", "position": list(pose().translation()), "intensity": 10.0}
    scene = scene_of(lamp, floor(), box=box(), **({"wall": wall()} if depth == 3 else {}))
    motion = perturb(scene, "box.vertex_positions", (1, 0, 0))
    budgets = {"form": "spatial", "sppc": 64, "sppp": 64, "sppd": 256, "sppi": 256}
    spec = {"type": "psdr_path", "max_depth": depth, **budgets}
    assert_grad_close(forward(motion, spec, 32, 64), fd(motion, spec, 0.001, 64, 4096), 0.01)
