"""Parameters of several numbers count by all of them: a light that moves along y moves."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit

pytestmark = pytest.mark.usefixtures("llvm")


def load() -> mi.Scene:
    look = mi.ScalarTransform4f().look_at([0, -4, 3], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]).scale(0.3)}
    lamp = {"type": "point", "position": [1, 1, 3]}
    sensor = {"type": "perspective", "to_world": look, "film": film}
    scene = {"type": "scene", "sensor": sensor, "floor": {"type": "rectangle"}, "box": box, "lamp": lamp}
    return mi.load_dict(scene, optimize=False)


@pytest.mark.parametrize("along", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_known_direction_is_known_by_all_its_components(along):
    budgets = {"type": "psdr_path", "max_depth": 2, "sppc": 16, "sppp": 16, "sppd": 16, "sppi": 16}
    images = [psdr_jit.gradient(load(), "lamp.position", along, integrator={**budgets, "direction": d}, seeds=1).total
              for d in ("any", "known")]  # fmt: skip
    assert np.abs(images[0]).max() > 0
    assert np.allclose(*images, atol=1e-4 * np.abs(images[0]).max())
