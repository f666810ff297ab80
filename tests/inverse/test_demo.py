"""The demonstration recovers a pose with the package's own loop."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.cli import demo_run
from psdr_jit.inverse.variables import rigid

ITERATIONS = 40


@pytest.fixture
def scene(llvm):
    return demo_run.load(32)


def vertices(scene):
    return np.array(mi.traverse(scene)[demo_run.PARAMETER]).reshape(-1, 3)


@pytest.mark.slow
def test_the_box_comes_back_and_the_scene_is_left_as_it_was(scene):
    before, seen = vertices(scene), []
    found = demo_run.recover_pose(scene, iterations=ITERATIONS, progress=lambda done, total, history: seen.append(done))
    assert seen == list(range(1, ITERATIONS + 1)) and np.array_equal(vertices(scene), before)
    assert len(found.losses) == ITERATIONS == len(found.offsets) - 1
    distance, angle = found.offsets[0]
    assert distance == pytest.approx(np.hypot(0.38, 0.15), rel=1e-4) and angle == pytest.approx(20, rel=1e-4)
    assert found.shift_px(-1) < 0.2 * found.shift_px(0) and found.angle_degrees(-1) < 8
    assert np.abs(found.last - found.target).mean() < 0.7 * np.abs(found.first - found.target).mean()


@pytest.mark.parametrize("degrees", [-20.0, 0.0, 75.0])
def test_offsets_are_those_of_a_rigid_motion(llvm, degrees):
    points = np.random.default_rng(0).random((8, 3)) - 0.5
    points -= points.mean(0)
    motion = rigid(mi.Vector3f(0.3, 0, -0.4), mi.Vector3f(0, float(np.deg2rad(degrees)), 0))
    moved = np.array(dr.ravel(motion @ mi.Point3f(points.T))).reshape(-1, 3)
    assert demo_run.offset(points, moved) == pytest.approx((0.5, abs(degrees)), abs=1e-4)


def test_ctrl_c_ends_the_demonstration(scene, monkeypatch):
    """The loop ends its iteration and returns; the next stage must not begin."""
    before, calls = vertices(scene), []

    def interrupted(*args, **kwargs):
        calls.append(args)
        return SimpleNamespace(status="interrupted")

    monkeypatch.setattr(demo_run, "optimize", interrupted)
    with pytest.raises(KeyboardInterrupt):
        demo_run.recover_pose(scene, iterations=4)
    assert len(calls) == 1 and np.array_equal(vertices(scene), before)
