"""Scenes that are far from the origin, or too large: one warning with the loss to expect, or an error."""

from __future__ import annotations

import re
import warnings

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.errors import SceneError, UnsupportedWarning
from psdr_jit.scene import io as scene_io

ORIGIN, TARGET = np.array([0.7, 2.2, 4.0]), np.array([0.0, -0.5, 0.0])
BLOCKER = "blocker.vertex_positions"
BUDGETS = {"type": "psdr_path", "max_depth": 2, "form": "material", "sppc": 1, "sppp": 16, "sppd": 64, "sppi": 1}

pytestmark = pytest.mark.usefixtures("llvm")


def placed(size: float, shift: float) -> mi.Scene:
    """A box, its shadow and the camera, scaled and then moved along x."""
    points = {name: ", ".join(f"{x:.9g}" for x in point * size + [shift, 0, 0])
              for name, point in (("origin", ORIGIN), ("target", TARGET))}  # fmt: skip
    lengths = {"size": size, "shift": shift, "near": 0.01 * size, "far": 1e4 * size, "res": 16}
    return scene_io.load_scene(scene_io.shipped_scene("stress_shadow.xml"), **points, **lengths)


def shadow_of(size: float, shift: float, spp: int = 64, seeds: int = 4) -> tuple[np.ndarray, list[str]]:
    """The derivative of the box's shadow, and the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = psdr_jit.gradient(placed(size, shift), BLOCKER, (size, 0, 0), integrator=BUDGETS, spp=spp, seeds=seeds)
    return result.terms["direct"], [str(w.message) for w in caught if w.category is UnsupportedWarning]


@pytest.mark.parametrize(("size", "shift", "way_out"), [
    (1, 1e3, "move it to the origin"), (1, 3e4, "move it to the origin"), (1e-3, 0, "scale the scene up"),
    (3e-4, 0, "scale the scene up"),
])  # fmt: skip
def test_the_warning_comes_once_and_gives_the_loss_of_this_scene(size, shift, way_out):
    whole, none = shadow_of(1, 0)
    found, (message,) = shadow_of(size, shift)
    told = float(re.search(r"lose about (\d+)%", message)[1]) / 100
    lost = 1 - np.sum(found * whole) / np.sum(whole * whole)
    assert not none and message.endswith(way_out)
    assert abs(told - lost) < 0.02 + 0.1 * lost


def test_far_away_the_outlines_suffer_too():
    (message,) = shadow_of(1, 1e6, spp=1, seeds=2)[1]
    assert "about 100% of the derivative of moving shadows and reflections, and a part of the outlines" in message


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("size", [1e10, 1e20])
def test_a_scene_that_overflows_is_refused(size):
    scene = placed(size, 0.0)
    for call in (psdr_jit.gradient, psdr_jit.check_gradient):
        with pytest.raises(SceneError, match="overflow single precision.*scale the scene down"):
            call(scene, BLOCKER, (size, 0, 0), spp=1)


def test_a_large_scene_that_does_not_overflow_is_not():
    assert psdr_jit.gradient(placed(1e8, 0.0), BLOCKER, (1e8, 0, 0), integrator=BUDGETS, spp=1, seeds=1).total.any()
