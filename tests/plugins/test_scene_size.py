"""Scenes that are far from the origin, or too large: one warning of what images lack, or an error."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from helpers import fd
from variants import also

import psdr_jit
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import SceneError, UnsupportedWarning
from psdr_jit.scene import io as scene_io

ORIGIN, TARGET = np.array([0.7, 2.2, 4.0]), np.array([0.0, -0.5, 0.0])
BLOCKER = "blocker.vertex_positions"
BUDGETS = {"type": "psdr_path", "max_depth": 2, "form": "material", "sppc": 1, "sppp": 16, "sppd": 64, "sppi": 1}
SPEC = {"type": "psdr_path", "max_depth": 2}
STEP, SEEDS = 0.01, 8

pytestmark = pytest.mark.usefixtures("llvm")


def placed(size: float, shift: float) -> mi.Scene:
    """A box, its shadow and the camera, scaled and then moved along x."""
    points = {name: ", ".join(f"{x:.9g}" for x in point * size + [shift, 0, 0])
              for name, point in (("origin", ORIGIN), ("target", TARGET))}  # fmt: skip
    lengths = {"size": size, "shift": shift, "near": 0.01 * size, "far": 1e4 * size, "res": 16}
    return scene_io.load_scene(scene_io.shipped_scene("stress_shadow.xml"), **points, **lengths)


def warned(scene: mi.Scene, size: float, **settings) -> tuple[np.ndarray, list[str]]:
    """The derivative as the box moves, and the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = psdr_jit.gradient(scene, BLOCKER, (size, 0, 0), **settings)
    return result.total, [str(w.message) for w in caught if w.category is UnsupportedWarning]


@pytest.mark.parametrize(("size", "shift", "way_out"), [
    (1, 0, ""), also(1, 1e3, "move it to the origin"), (1, 3e4, "move it to the origin"),
    also(1e-3, 0, "scale the scene up"), (3e-4, 0, "scale the scene up"),
])  # fmt: skip
def test_one_warning_and_the_derivative_of_the_image(size, shift, way_out):
    """Rays start so high that shadows shrink, by 22 % of the scene at 3e4 units to nothing: the derivative follows."""
    scene = placed(size, shift)
    ours, messages = warned(scene, size, integrator=SPEC, spp=256, seeds=SEEDS)
    assert len(messages) == (1 if way_out else 0)
    assert all(message.endswith(way_out) for message in messages)
    differences = fd(perturb(scene, BLOCKER, (size, 0, 0)), SPEC, STEP, SEEDS, 2048)
    theirs, noise = differences.mean(0), differences.std(0) / np.sqrt(SEEDS)
    slope = np.sum(ours * theirs) / np.sum(theirs**2)
    error = np.sqrt(np.sum((noise * theirs) ** 2)) / np.sum(theirs**2)
    assert abs(slope - 1) < 0.05 + 3 * error
    assert np.sum((ours - theirs) ** 2) < 0.12**2 * np.sum(theirs**2)


def test_far_away_the_outlines_suffer_too():
    (message,) = warned(placed(1, 1e6), 1, integrator=BUDGETS, spp=1, seeds=2)[1]
    assert "images lack shadows and reflections of what is lower" in message
    assert "and rounding a part of the outlines" in message


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("size", [1e10, 1e20])
def test_a_scene_that_overflows_is_refused(size):
    scene = placed(size, 0.0)
    for call in (psdr_jit.gradient, psdr_jit.check_gradient):
        with pytest.raises(SceneError, match="overflow single precision.*scale the scene down"):
            call(scene, BLOCKER, (size, 0, 0), spp=1)


def test_a_large_scene_that_does_not_overflow_is_not():
    assert psdr_jit.gradient(placed(1e8, 0.0), BLOCKER, (1e8, 0, 0), integrator=BUDGETS, spp=1, seeds=1).total.any()
