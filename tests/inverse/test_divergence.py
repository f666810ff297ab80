"""Runs that are lost end with the best state; noisy ones that are not, go on."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from inverse_problems import BOX, LAMP, problem_of, write_config
from variants import also

from psdr_jit import Parameter, Pose, Vertices
from psdr_jit.cli import main
from psdr_jit.errors import OptionError
from psdr_jit.inverse import loop
from psdr_jit.inverse.history import LONG, History

START = {"start_shift": (0.2, 0, -0.1)}


@pytest.mark.parametrize("variable", [
    also(Pose(BOX, 1e30, **START)), also(Pose(BOX, 1e5, **START)), Pose(BOX, 1e39, **START), also(Pose(LAMP, 1e5)),
    also(Pose("camera.to_world", 1e6)), Pose(BOX, 0.1, turn_axes="y", turn_rate=1e30, **START),
    Vertices(BOX, 1e10, smoothness=0.0), also(Parameter(LAMP, 1e6)),
    Parameter("lamp.intensity.value", 1e25, start_at=8.0),
])  # fmt: skip
def test_values_that_run_away_end_the_run(llvm, variable):
    problem = problem_of([variable], iterations=12)
    with pytest.warns(RuntimeWarning, match=r"(has left the scene|has grown to|not finite|diverged).*is kept"):
        result = loop.run(problem)
    assert result.status == "diverged" and result.iterations < 12
    assert result.offsets == result.start_offsets  # the best state: nothing since was any better
    assert np.all(np.isfinite(np.array(mi.traverse(problem.scene)[BOX])))


def test_the_last_step_counts_as_well(llvm):
    with pytest.warns(RuntimeWarning, match="has left the scene"):
        assert loop.run(problem_of([Pose(BOX, 1e6, **START)], iterations=1)).status == "diverged"


@pytest.mark.filterwarnings("ignore::psdr_jit.errors.StalledWarning")
def test_a_body_that_nothing_depends_on_any_more(llvm):
    """It is not far, but out of view, and its gradient is 0."""
    with pytest.warns(RuntimeWarning, match="has left the scene.*does not depend on it any more"):
        result = loop.run(problem_of([Pose(BOX, 2.0, **START)], iterations=40))
    assert result.status == "diverged" and result.iterations < 40


@pytest.mark.filterwarnings("ignore::psdr_jit.errors.StalledWarning")
def test_a_body_that_never_had_a_gradient_is_only_warned_about(llvm):
    result = loop.run(problem_of([Pose(BOX, 0.02, start_shift=(60, 0, 0))], iterations=14))
    assert result.status == "finished"


def test_a_resumed_run_remembers_where_the_scene_was(llvm, tmp_path):
    """Not far enough to be noticed before the interruption; what is far is measured from the start all the same."""
    problem = problem_of([Pose(BOX, 2.5e3, **START)], iterations=2, stalled_after=100)
    loop.run(problem, tmp_path)
    with pytest.warns(RuntimeWarning, match="has left the scene, by 1"):
        problem = problem_of([Pose(BOX, 2.5e3, **START)], iterations=40, stalled_after=100)
        assert loop.run(problem, tmp_path, resume=True).status == "diverged"


def test_exit_status_and_what_is_kept(llvm, tmp_path, capsys):
    config = write_config(tmp_path, 20, **{"learning_rate = 0.02": "learning_rate = 1e30"})
    assert main.main(["optimize", str(config), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    assert "diverged after" in said.out and "is kept" in said.err
    with np.load(tmp_path / "out" / "final.npz") as values:
        assert np.abs(values[BOX]).max() < 10


def test_rates_that_are_not_finite_are_refused(llvm):
    for rate in (float("inf"), float("nan"), -1.0):
        with pytest.raises(OptionError, match="above 0 and finite"):
            problem_of([Pose(BOX, rate)])


@pytest.mark.parametrize(
    "kind", ["far camera", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("bright", "noisy"))]
)
def test_honest_runs_are_not_flagged(llvm, kind):
    variable = {
        "far camera": Pose("camera.to_world", 0.05, start_shift=(0.0, 0.0, -20.0)),
        "bright": Parameter("lamp.intensity.value", 1.0, start_at=30.0),
        "noisy": Pose(BOX, 0.02, turn_axes="y", turn_rate=1.0, **START),
    }[kind]
    assert loop.run(problem_of([variable], iterations=30, spp=1)).status == "finished"


def history_of(losses, signed=False):
    history, flagged = History(period=1, signed=signed, start="start"), False
    for k, loss in enumerate(losses):
        history.add(float(loss), k)
        flagged |= history.regressed
    return history, flagged


def test_what_was_found_and_lost_again_is_noticed():
    history, flagged = history_of([*[1.0] * 10, *[0.01] * 20, *[2.0] * (LONG + 1)])
    assert flagged and 10 <= history.best < 30


def test_noise_is_no_regression():
    rng = np.random.default_rng(0)
    for level in (1.0, 0.05):  # a run that finds nothing, and one that gets better and stays there
        noisy = np.concatenate([rng.lognormal(sigma=1.5, size=20), level * rng.lognormal(sigma=1.5, size=3000)])
        assert not history_of(noisy)[1]
    assert not history_of(rng.normal(size=3000), signed=True)[1]


def test_the_count_survives_a_checkpoint():
    history, _ = history_of([*[1.0] * 10, *[0.01] * 20, *[2.0] * 30])
    other = History(period=1, signed=False, start="start")
    other.restore(history.arrays(), "best")
    assert other.above == history.above == 30
    for k in range(LONG - 30):
        other.add(2.0, k)
    assert other.regressed
