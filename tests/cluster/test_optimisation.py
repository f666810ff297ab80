"""Optimisations by workers: step by step what this process does, also if one dies; a lost scheduler loses nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.errors import ClusterError
from psdr_jit.scene import io as scene_io

pytestmark = pytest.mark.slow

FILE = str(scene_io.shipped_scene("inverse/eight_views.xml"))
RES = {"res": 16}
BUDGETS = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4}
SHADOW = str(scene_io.shipped_scene("point_shadow.xml"))
SHADOW_RES = {"res": 16, "max_depth": 2}
TOML = f'scene = "{SHADOW}"\nspp = 4\n' + """iterations = {iterations}
[defaults]
res = 16
[integrator]
max_depth = 2
sppc = 4
sppp = 4
sppi = 4
[[target]]
render = 16
[[variable]]
kind = "parameter"
parameter = "lamp.intensity.value"
learning_rate = 0.1
start_at = 8.0
"""
ROUNDING = 5e-3  # of losses and offsets after some steps: a last bit may flip a sample, also within one process
EXACT = 1e-6  # after one step


@pytest.fixture(autouse=True)
def variant(llvm) -> None:
    """As the command has it."""


def shadow_box(**settings: Any) -> Any:
    """Result of an optimisation from one image."""
    scene = scene_io.load_scene(SHADOW, **SHADOW_RES)
    target = np.array(mi.render(scene, spp=64))
    box = psdr_jit.Pose("blocker.vertex_positions", 0.02, turn_rate=1.0, turn_axes="y", start_shift=(0.2, 0, -0.1))
    lamp = psdr_jit.Parameter("lamp.intensity.value", 0.1, lower=0.5, start_at=8.0)
    given = {"iterations": 6, "spp": 4, "integrator": BUDGETS, "checkpoint_every": 100, **settings}
    return psdr_jit.optimize(scene, [box, lamp], target, **given)


def by(client: Any) -> dict[str, Any]:
    return {"client": client, "source": psdr_jit.SceneFile(SHADOW, SHADOW_RES)}


def assert_same(a: Any, b: Any, tolerance: float = ROUNDING) -> None:
    assert (a.status, a.iterations) == (b.status, b.iterations)
    assert np.allclose(a.losses, b.losses, rtol=tolerance)
    for name, kinds in a.offsets.items():
        for kind, value in kinds.items():
            assert b.offsets[name][kind] == pytest.approx(value, rel=tolerance)


@pytest.mark.parametrize("control_variate", [False, True])
def test_two_workers_step_as_this_process_does(two, control_variate):
    how = {"control_variate": control_variate}
    assert_same(shadow_box(**how), shadow_box(**how, **by(two)))


def test_views_are_added_up_and_poses_of_cameras_follow(two):
    def found(**who: Any) -> Any:
        scene = scene_io.load_scene(FILE, **RES)
        targets = {k: np.array(mi.render(scene, sensor=k, spp=16)) for k in (0, 3)}
        camera = psdr_jit.Pose("view0.to_world", 2.0, start_shift=(0.05, 0, 0))
        body = psdr_jit.Pose("body.vertex_positions", 2.0, start_shift=(0, 0.1, 0))
        plain = {"type": "sgd"}  # Adam would hide a factor, and make much of the rounding of what is nearly 0
        one = {"iterations": 1, "spp": 4, "integrator": BUDGETS, "optimizer": plain}
        return psdr_jit.optimize(scene, [camera, body], targets, **one, **who)

    own = found()
    moved = {name: abs(own.offsets[name]["distance"] / at["distance"] - 1) for name, at in own.start_offsets.items()}
    assert min(moved.values()) > 0.01, "the test has no power: raise the learning rates"
    assert_same(own, found(client=two, source=psdr_jit.SceneFile(FILE, RES)), EXACT)


def test_samples_by_noise_are_settled_at_the_start(two):
    """Without budgets of the caller: as many workers as one likes give the same, and it converges."""
    from psdr_jit.cluster import engine

    own = {"iterations": 12, "integrator": {"type": "psdr_path", "max_depth": 2}}
    with engine.local(1) as one:
        alone = shadow_box(**own, **by(one))
    several = shadow_box(**own, **by(two))
    assert_same(alone, several)
    start, now = (kinds["blocker.vertex_positions"]["distance"] for kinds in (several.start_offsets, several.offsets))
    assert now < 0.7 * start


def test_a_killed_worker_changes_nothing(two):
    before = set(two.run(os.getpid).values())
    shot: list[int] = []

    def shoot(done: int, total: int, note: str) -> None:
        if done == 2:
            shot.append(next(iter(before)))
            os.kill(shot[0], signal.SIGKILL)

    undisturbed = shadow_box()
    assert_same(undisturbed, shadow_box(**by(two), progress=shoot))
    two.wait_for_workers(2, timeout=60)
    assert shot and shot[0] not in two.run(os.getpid).values()


def test_a_lost_scheduler_leaves_a_checkpoint(tmp_path: Path, two):
    distributed = pytest.importorskip("distributed")
    address = "tcp://127.0.0.1:18787"
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "18787"]
    scheduler = subprocess.Popen([*command, "--no-dashboard"], stderr=subprocess.DEVNULL)
    command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
    worker = subprocess.Popen([*command, "--host", "127.0.0.1"], stderr=subprocess.DEVNULL)

    def shoot(done: int, total: int, note: str) -> None:
        if done == 3:
            scheduler.kill()

    try:
        with distributed.Client(address, timeout=60) as client:
            with pytest.raises(ClusterError, match="is gone"):
                shadow_box(**by(client), out=tmp_path / "run", progress=shoot)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    assert (tmp_path / "run" / "checkpoint.npz").is_file()
    rest = shadow_box(**by(two), out=tmp_path / "run", resume=True)
    undisturbed = shadow_box()
    assert len(rest.losses) == 3 and np.allclose(rest.losses, undisturbed.losses[3:], rtol=ROUNDING)
    assert rest.offsets["lamp.intensity.value"]["rms"] == pytest.approx(
        undisturbed.offsets["lamp.intensity.value"]["rms"], rel=ROUNDING
    )


def test_command_line(tmp_path: Path, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    Path("a.toml").write_text(TOML.format(iterations=3), encoding="utf-8")
    found = []
    for extra in ([], ["--workers", "2"]):
        assert main(["optimize", "a.toml", "--out", f"out{len(found)}", *extra]) == 0
        found.append(capsys.readouterr().out.splitlines()[1])
    assert found[0] == found[1] and "lamp.intensity.value" in found[0]


def test_ctrl_c_ends_the_run_in_order(tmp_path: Path):
    """A terminal interrupts the workers, too; they leave it to the process that has asked."""
    pytest.importorskip("distributed")
    (tmp_path / "a.toml").write_text(TOML.format(iterations=100000), encoding="utf-8")
    command = [sys.executable, "-m", "psdr_jit.cli.main", "optimize", "a.toml", "--workers", "2", "--out", "run"]
    log = tmp_path / "run" / "log.jsonl"
    run = subprocess.Popen(command, cwd=tmp_path, start_new_session=True, stdout=subprocess.PIPE,
                           stderr=subprocess.STDOUT, text=True)  # fmt: skip
    try:
        deadline = time.monotonic() + 120
        while not (log.is_file() and len(log.read_text().splitlines()) > 3):
            assert time.monotonic() < deadline and run.poll() is None
            time.sleep(0.2)
        os.killpg(run.pid, signal.SIGINT)
        said, _ = run.communicate(timeout=60)
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 130 and "go on with --resume" in said and "Traceback" not in said, said
    assert (tmp_path / "run" / "checkpoint.npz").is_file()
