"""Derivatives by workers: the numbers of this process, whoever dies on the way; what cannot be mended has a name."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from clusters import BOX, FILE, RES

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.cluster import engine
from psdr_jit.derivative import images
from psdr_jit.errors import ClusterError, OptionError, SceneError, UnsupportedWarning

pytestmark = pytest.mark.slow

ROUNDING = 1e-5  # of the largest value
MOVE = dict(direction=(1, 0, 0), spp=4, seeds=4)


def assert_same(a: psdr_jit.GradientResult, b: psdr_jit.GradientResult) -> None:
    assert a.layers().keys() == b.layers().keys() and a.rejected == b.rejected
    for name, image in a.layers().items():
        size = np.abs(a.layers()[name.removesuffix("_stderr")]).max()  # errors come from differences of images
        assert np.abs(image - b.layers()[name]).max() <= ROUNDING * size, name
    assert np.any(a.total)


@pytest.fixture(scope="module")
def here(scene) -> psdr_jit.GradientResult:
    return psdr_jit.gradient(scene, BOX, **MOVE)


@pytest.mark.parametrize("small", [engine.SMALL, 0])
def test_two_workers_give_what_this_process_gives(scene, source, two, here, small, monkeypatch):
    """Also where the state of the scene is a task of its own."""
    monkeypatch.setattr(engine, "SMALL", small)
    assert_same(here, psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source))


def test_one_worker_as_well(scene, source, two, here):
    with engine.local(1) as client:
        assert_same(here, psdr_jit.gradient(scene, BOX, **MOVE, client=client, source=source))


@pytest.mark.parametrize("spec", ["prb", {"type": "psdr_path", "sppi": 0}, "psdr_bdpt"])
def test_other_integrators(scene, source, two, spec):
    own = psdr_jit.gradient(scene, BOX, **MOVE, integrator=spec)
    assert_same(own, psdr_jit.gradient(scene, BOX, **MOVE, integrator=spec, client=two, source=source))


def test_parameters_that_were_changed_are_sent(scene, source, two, here):
    params = psdr_jit.traverse(scene)
    before = type(params[BOX])(params[BOX])
    try:
        params[BOX] = before + 0.05
        params.update()
        moved = psdr_jit.gradient(scene, BOX, **MOVE)
        assert_same(moved, psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source))
    finally:
        params[BOX] = before
        params.update()
    assert np.abs(moved.total - here.total).max() > 0.01 * np.abs(here.total).max()
    assert_same(here, psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source))


def test_poses_and_rotations(scene, source, two):
    turn = dict(rotate=(0, 1, 0), spp=4, seeds=2)
    with pytest.warns(UnsupportedWarning, match="'floor' and 'back' touch"):
        own = psdr_jit.gradient(scene, "floor.to_world", **turn)
    with pytest.warns(UnsupportedWarning, match="'floor' and 'back' touch"):  # workers find this out, not this process
        assert_same(own, psdr_jit.gradient(scene, "floor.to_world", **turn, client=two, source=source))


def test_a_check_passes_or_is_undecided_with_the_right_gain(scene, source, two):
    found = psdr_jit.check_gradient(scene, BOX, (1, 0, 0), spp=32, max_seconds=30, client=two, source=source)
    v = found.verdict
    assert v.verdict != "fail" and abs(v.gain - 1) < 0.02 + 5 * v.gain_stderr < 0.3


def killed_soon(client: Any, after: float) -> threading.Thread:
    """Kills a worker while it computes."""

    def kill() -> None:
        time.sleep(after)
        os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


def test_a_worker_that_is_killed_costs_time_only(scene, source, two):
    work = dict(direction=(1, 0, 0), spp=64, seeds=12)
    own = psdr_jit.gradient(scene, BOX, **work)
    before = set(two.run(os.getpid).values())
    thread = killed_soon(two, after=0.5)
    found = psdr_jit.gradient(scene, BOX, **work, client=two, source=source)
    thread.join()
    two.wait_for_workers(2, timeout=60)
    assert set(two.run(os.getpid).values()) != before, "nobody was killed"
    assert_same(own, found)


def test_a_scheduler_that_is_gone_is_named(scene, source):
    distributed = pytest.importorskip("distributed")
    port = 18786
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1",
                                  "--port", str(port), "--no-dashboard"], stderr=subprocess.DEVNULL)  # fmt: skip
    address = f"tcp://127.0.0.1:{port}"
    worker = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1",
                               "--no-nanny", "--host", "127.0.0.1"], stderr=subprocess.DEVNULL)  # fmt: skip
    try:
        with distributed.Client(address, timeout=60) as client:
            client.wait_for_workers(1, timeout=60)
            threading.Timer(3.0, scheduler.kill).start()
            with pytest.raises(ClusterError, match=f"scheduler at '{address}' is gone.*start it anew"):
                psdr_jit.gradient(scene, BOX, (1, 0, 0), spp=256, seeds=64, client=client, source=source)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()


@pytest.fixture
def only_here(tmp_path, monkeypatch) -> str:
    """A scene file under a path that leads elsewhere in the workers, which were started in another folder."""
    copy = tmp_path / "cbox.xml"
    copy.write_text(Path(FILE).read_text(encoding="utf-8") + "<!-- another file -->\n", encoding="utf-8")
    shutil.copytree(os.path.join(os.path.dirname(FILE), "meshes"), tmp_path / "meshes")
    monkeypatch.chdir(tmp_path)
    return "/proc/self/cwd/cbox.xml"


def test_a_file_that_workers_lack_is_named_and_may_travel(scene, two, here, only_here):
    with pytest.raises(SceneError, match=f"on machine '.+': scene file '{only_here}' does not exist there.*send=True"):
        psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=psdr_jit.SceneFile(only_here, RES))
    sent = psdr_jit.SceneFile(only_here, RES, send=True)
    assert_same(here, psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=sent))


def test_other_versions_are_named(scene, source, two, monkeypatch):
    monkeypatch.setattr(psdr_jit, "__version__", "0.0.0")
    with pytest.raises(ClusterError, match=r"on machine '.+': there is psdr_jit .* instead of 0\.0\.0"):
        psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source)


def test_wrong_requests_are_refused_here(scene, source, two):
    with pytest.raises(OptionError, match="source=psdr_jit.SceneFile"):
        psdr_jit.gradient(scene, BOX, **MOVE, client=two)
    with pytest.raises(OptionError, match=r"distributed\.Client"):
        psdr_jit.gradient(scene, BOX, **MOVE, client="tcp://nowhere", source=source)
    with pytest.raises(OptionError, match="is not the one in"):
        psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=str(psdr_jit.scene_io.shipped_scene("mirrors.xml")))
    with pytest.raises(OptionError, match="properties as a dict"):
        path = mi.load_dict({"type": "psdr_path"})
        psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source, integrator=path)


def test_only_this_machine_can_connect(two):
    ours = set(two.run(os.getpid).values()) | {os.getpid()}
    addresses = [two.scheduler.address, *two.scheduler_info(n_workers=-1)["workers"]]
    assert ours and all("//127.0.0.1:" in address for address in addresses)


def test_command_line(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    how = ["--direction", "1,0,0", "--spp", "4", "--seeds", "2", "--quiet"]
    move = ["gradient", FILE, "-D", "res=16", "--wrt", BOX, *how]
    assert main([*move, "-o", "a.exr"]) == 0
    assert main([*move, "-o", "b.exr", "--workers", "2"]) == 0
    one, other = images.read_exr("a.exr"), images.read_exr("b.exr")
    for name, plane in one.items():
        assert np.abs(plane - other[name]).max() <= ROUNDING * np.abs(one[name.replace("_stderr", "")]).max(), name
