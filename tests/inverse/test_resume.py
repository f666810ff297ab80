"""Interruption: by Ctrl-C, by SIGKILL, by a full disk. What was kept continues as if nothing had happened."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from inverse_problems import BOX, problem_of, write_config

from psdr_jit import Pose, Vertices
from psdr_jit.derivative import images
from psdr_jit.errors import CheckpointError, OptionError
from psdr_jit.inverse import checkpoint as checkpoints
from psdr_jit.inverse import loop

FIXED = {"[integrator]": "[integrator]\nsppc = 4\nsppp = 4\nsppi = 4"}  # else budgets follow a new pilot after resuming


def command(config, out, *more):
    return [sys.executable, "-m", "psdr_jit.cli.main", "optimize", str(config), "--out", str(out), "--quiet", *more]


def rows(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def final(out):
    with np.load(out / "final.npz") as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing interrupts."""
    folder = tmp_path_factory.mktemp("whole")
    config = write_config(folder, 20, **FIXED)
    subprocess.run(command(config, folder / "out"), check=True)
    return config, folder / "out"


def same_as_whole(whole, out):
    expected, found = rows(whole[1]), rows(out)
    assert [row["iteration"] for row in found] == list(range(20))
    assert np.allclose([r["loss"] for r in found], [r["loss"] for r in expected], rtol=1e-3)
    for name, value in final(whole[1]).items():
        assert np.allclose(final(out)[name], value, rtol=1e-4, atol=1e-4)


def started(config, out, reach):
    """A running process that has done `reach` iterations."""
    process = subprocess.Popen(command(config, out), stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + 120
    while time.monotonic() < limit and process.poll() is None:
        if (out / "log.jsonl").is_file() and len((out / "log.jsonl").read_text().splitlines()) >= reach:
            return process
        time.sleep(0.01)
    pytest.fail(f"the process has not reached iteration {reach}: {process.poll()}")


def test_killed_and_resumed(llvm, whole, tmp_path):
    config, _ = whole
    process = started(config, tmp_path / "out", reach=8)
    process.kill()
    process.wait()
    stored = json.loads(str(np.load(tmp_path / "out" / "checkpoint.npz")["header"]))
    assert stored["iteration"] % 5 == 0 and stored["iteration"] >= 5  # at most one interval of 5 is lost
    subprocess.run(command(config, tmp_path / "out", "--resume"), check=True)
    same_as_whole(whole, tmp_path / "out")


@pytest.mark.slow
def test_interrupted_and_resumed(llvm, whole, tmp_path):
    config, _ = whole
    process = started(config, tmp_path / "out", reach=7)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    done = len(rows(tmp_path / "out"))
    stored = json.loads(str(np.load(tmp_path / "out" / "checkpoint.npz")["header"]))
    assert stored["iteration"] == done < 20  # nothing is lost
    subprocess.run(command(config, tmp_path / "out", "--resume"), check=True)
    same_as_whole(whole, tmp_path / "out")


def test_an_earlier_run_is_not_overwritten(llvm, whole):
    config, out = whole
    done = subprocess.run(command(config, out), capture_output=True, text=True)
    assert done.returncode == 2 and "--resume" in done.stderr


def test_a_finished_run_says_that_nothing_is_left(llvm, whole, tmp_path):
    config, out = whole
    shutil.copytree(out, tmp_path / "out")
    told = [word for word in command(config, tmp_path / "out", "--resume") if word != "--quiet"]
    done = subprocess.run(told, capture_output=True, text=True)
    assert done.returncode == 0 and "nothing left to do" in done.stdout
    same_as_whole(whole, tmp_path / "out")


def test_what_a_run_leaves(llvm, whole):
    _, out = whole
    names = {path.name for path in out.iterdir()}
    assert {"log.jsonl", "checkpoint.npz", "result.png", "curves.png", "final.npz", "final.xml", "final_files",
            "result.json", "snapshots"} <= names  # fmt: skip
    row = rows(out)[3]
    assert set(row) == {"iteration", "loss", "gradient_norm", "seconds", "views", "rate", "offset"}
    assert (out / "snapshots" / "000000.exr").is_file()
    assert json.loads((out / "result.json").read_text())["status"] == "finished"


def test_another_problem_is_not_resumed(llvm, tmp_path):
    loop.run(problem_of(iterations=2), tmp_path)
    with pytest.raises(CheckpointError, match="another problem"):
        loop.run(problem_of(iterations=4, seed=3), tmp_path, resume=True)
    result = loop.run(problem_of(iterations=4), tmp_path, resume=True)  # more iterations are the same problem
    assert result.iterations == 4 and len(result.losses) == 2


def test_whatever_was_asked_for_belongs_to_the_problem(llvm, tmp_path):
    variable = {"parameter": BOX, "learning_rate": 0.02, "turn_axes": "y", "turn_rate": 1.0}
    loop.run(problem_of([Pose(**variable)], iterations=2), tmp_path)
    for change in ({"pivot": (5, 0, 0)}, {"shift_axes": "xz"}, {"start_shift": (0.1, 0, 0)}, {"learning_rate": 0.03}):
        with pytest.raises(CheckpointError, match="another problem"):
            loop.run(problem_of([Pose(**{**variable, **change})], iterations=4), tmp_path, resume=True)
    with pytest.raises(CheckpointError, match="other targets"):
        other = problem_of([Pose(**variable)], targets=np.ones((16, 16, 3)), iterations=4)
        loop.run(other, tmp_path, resume=True)
    with pytest.raises(OptionError, match="earlier run"):
        loop.run(problem_of([Pose(**variable)], iterations=2), tmp_path)


@pytest.mark.slow
def test_vertices_are_resumed(llvm, tmp_path):
    loop.run(problem_of([Vertices(BOX, 0.01, smoothness=2.0)], iterations=2), tmp_path)
    result = loop.run(problem_of([Vertices(BOX, 0.01, smoothness=2.0)], iterations=4), tmp_path, resume=True)
    assert result.iterations == 4 and result.start_offsets[BOX]["rms"] < 1e-5 < result.offsets[BOX]["rms"]


def test_a_run_without_time(llvm, tmp_path):
    result = loop.run(problem_of(iterations=5, max_seconds=1e-9), tmp_path)
    assert result.status == "out of time" and result.iterations == 0 and result.losses == []
    assert json.loads((tmp_path / "result.json").read_text())["loss"] is None


def test_final_values_have_their_shapes(llvm, tmp_path):
    scene_pose = Pose("camera.to_world", 0.01)
    problem = problem_of([scene_pose, Pose(BOX, 0.01)], iterations=1)
    loop.run(problem, tmp_path)
    values = final(tmp_path)
    assert values[BOX].shape == (24, 3)
    assert np.allclose(values["camera.to_world"][:3, 3], [0.7, 2.2, 4], atol=0.05)


def test_checkpoints_that_cannot_be_read(llvm, tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        loop.run(problem_of(iterations=2), tmp_path, resume=True)
    for content in (b"half a file", b""):
        (tmp_path / "checkpoint.npz").write_bytes(content)
        with pytest.raises(CheckpointError, match="start anew"):
            loop.run(problem_of(iterations=2), tmp_path, resume=True)
    with pytest.raises(OptionError, match="folder"):
        loop.run(problem_of(iterations=2), resume=True)


def test_moments_are_restored(llvm):
    problem = problem_of(iterations=3)
    stepper = loop.Stepper(problem)
    for _ in range(3):
        stepper.step()
    kept = stepper.arrays()
    other = loop.begin(problem)
    checkpoints.restore_optimisers(other.optimisers, kept)
    again = checkpoints.optimiser_arrays(other.optimisers)
    assert set(again) == set(kept) and all(np.array_equal(again[name], kept[name]) for name in kept)
    assert sum(np.abs(value).sum() > 0 for value in kept.values()) >= 6  # values, both moments, counters


def test_a_full_disk_leaves_the_old_checkpoint(llvm, tmp_path):
    """In a child process whose files may not grow beyond the first checkpoint's size."""
    loop.run(problem_of(iterations=2), tmp_path)
    before = (tmp_path / "checkpoint.npz").read_bytes()
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, len(before) // 2))
        try:
            checkpoints.save(
                tmp_path / "checkpoint.npz", checkpoints.load(tmp_path / "checkpoint.npz", fingerprint(before))
            )
        except CheckpointError as error:
            os._exit(0 if "the checkpoint before it is intact" in str(error) else 3)
        os._exit(4)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
    assert not list(tmp_path.glob(".*"))


def fingerprint(content: bytes) -> str:
    import io

    return json.loads(str(np.load(io.BytesIO(content))["header"]))["fingerprint"]


def test_a_full_disk_does_not_end_a_run(llvm, tmp_path, monkeypatch):
    def full(*args):
        raise CheckpointError("no space left")

    def failed(*args, **named):
        raise RuntimeError("OpenEXR says this where others say OSError")

    monkeypatch.setattr(checkpoints, "save", full)
    monkeypatch.setattr(images, "write_exr", failed)
    with pytest.warns(RuntimeWarning, match="the optimisation goes on"):
        result = loop.run(problem_of(iterations=3, checkpoint_every=1), tmp_path)
    assert result.status == "finished" and set(result.not_written) == {"checkpoint.npz", "snapshots", "views"}
