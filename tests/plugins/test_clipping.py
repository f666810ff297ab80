"""Clipping planes: what lies behind `far_clip` is not behind an outline; what they cut where it is seen is named."""

from __future__ import annotations

import re
import warnings

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.errors import UnsupportedWarning

pytestmark = pytest.mark.usefixtures("llvm")

BUDGETS = {"sppc": 64, "sppp": 64, "sppd": 64, "sppi": 64}


def load(plugin: str = "perspective", wall: bool = False, **clip: float) -> mi.Scene:
    """A box at distance 4 before a wall at distance 7, on a floor that reaches from 1 to 7, lit by a point."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    pose = T().look_at([0, 4, 1], [0, 0, 0.5], [0, 0, 1])
    pose = pose if plugin == "perspective" else pose @ T().scale([2, 2, 1])
    sensor = {"type": plugin, "to_world": pose, "film": film, **clip}
    scene = {"type": "scene", "sensor": sensor, "lamp": {"type": "point", "position": [1, 3, 4], "intensity": 20.0},
             "box": {"type": "cube", "to_world": T().translate([0, 0, 0.5]).scale(0.4)}}  # fmt: skip
    if wall:
        scene["wall"] = {"type": "rectangle", "to_world": T().translate([0, -3, 0]).rotate([1, 0, 0], -90).scale(5)}
    else:
        scene["floor"] = {"type": "rectangle", "to_world": T().scale(3)}
    return mi.load_dict(scene, optimize=False)


def derivative(scene: mi.Scene) -> np.ndarray:
    integrator = {"type": "psdr_path", "max_depth": 2, **BUDGETS}
    return psdr_jit.gradient(scene, "box.vertex_positions", (1, 0, 0), integrator=integrator, seeds=2).total


@pytest.mark.parametrize("plugin", ["perspective", "orthographic"])
@pytest.mark.parametrize("clip, named", [
    ({"near_clip": 3.7}, "near_clip.* cuts 'box'"), ({"far_clip": 5.0}, "far_clip.* cuts 'floor'"), ({}, ""),
    ({"near_clip": 0.5, "far_clip": 20.0}, ""),
])  # fmt: skip
def test_what_is_cut_where_it_is_seen_is_named(plugin, clip, named):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        derivative(load(plugin, **clip))
    messages = " ".join(str(w.message) for w in told if issubclass(w.category, UnsupportedWarning))
    if named:
        assert re.search(named, messages)
    else:
        assert "clip" not in messages


def test_what_is_too_far_is_not_seen_behind_outlines():
    """With a wall behind `far_clip`, which the lamp reaches and no camera ray does: as without the wall."""
    clipped, seen = (derivative(load(wall=True, far_clip=far)) for far in (5.5, 100.0))
    beside = derivative(load(wall=False, far_clip=5.5))
    assert np.abs(clipped - seen).max() > 0.3 * np.abs(clipped).max()
    row = slice(0, 5)  # above the floor
    assert np.allclose(clipped[row], beside[row], atol=0.05 * np.abs(clipped).max())
