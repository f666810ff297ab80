"""Curved shapes behind hidden lights are named, meshes and what lies beside the lights are not."""

from __future__ import annotations

import warnings

import mitsuba as mi
import pytest

from psdr_jit.core.memory import Memory
from psdr_jit.scene.behind_lights import warn_about_shapes_behind_lights
from psdr_jit.scene.facts import analyse

CASES = {  # shape, its place, sensor: named?
    "ball-behind": ("sphere", (0, 0, 0), "perspective", True),
    "ball-beside": ("sphere", (3, 0, 0), "perspective", False),
    "ball-before": ("sphere", (0, 0, 6), "perspective", False),
    "box-behind": ("cube", (0, 0, 0), "perspective", False),
    "parallel-behind": ("sphere", (0.5, 0, 0), "orthographic", True),
    "parallel-beside": ("sphere", (2, 0, 0), "orthographic", False),
}


@pytest.mark.parametrize("case", CASES)
def test_who_is_named(llvm, case):
    kind, place, sensor, named = CASES[case]
    T = mi.ScalarTransform4f
    scene = mi.load_dict({
        "type": "scene", "camera": {"type": sensor, "to_world": T().look_at([0, 0, 10], [0, 0, 0], [0, 1, 0])},
        "lamp": {"type": "sphere", "center": [0, 0, 3], "radius": 0.5, "emitter": {"type": "area"}},
        "thing": {"type": kind, "to_world": T().translate(place).scale(0.5)},
    })  # fmt: skip
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_about_shapes_behind_lights(scene, scene.sensors()[0], analyse(scene), Memory())
    assert [("'lamp'" in str(w.message), "'thing'" in str(w.message)) for w in found] == [(True, True)] * named
