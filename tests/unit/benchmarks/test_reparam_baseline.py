"""How the benchmark talks to the old Mitsuba: scene, curve, environment and errors. Nothing here needs a network."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.baselines import reparam
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import OptionError, SetupError
from psdr_jit.scene import io as scene_io

ALLOWED = {"__future__", "ctypes", "json", "platform", "sys", "time", "typing", "numpy", "mitsuba", "drjit"}
SCENE = scene_io.shipped_scene("seamed_cube.xml")
CUBE = "cube.vertex_positions"

ECHO = """
import json, sys
import numpy as np
request = json.load(sys.stdin)
np.savez(request["output"], images=np.full((2, 1, 1, 3), request["spp"], np.float32), seconds=[0.5, 0.25],
         warm_up_seconds=1.5, versions=json.dumps({"integrator": request["integrator"]["type"]}))
"""
FAIL = "import sys\nprint('first', file=sys.stderr)\nprint('the cause', file=sys.stderr)\nsys.exit({status})\n"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an environment that is not there yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return reparam.environment_folder()


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands of an installation, recorded instead of run; the first one makes an interpreter."""
    ran: list[list[str]] = []

    def install(command: list[str]) -> None:
        python = reparam.environment_folder() / "bin" / "python"
        python.parent.mkdir(parents=True, exist_ok=True)
        python.touch()
        ran.append(command)

    monkeypatch.setattr(reparam, "run_step", install)
    monkeypatch.setattr(reparam, "find_python", lambda: "python")
    return ran


def worker(monkeypatch: pytest.MonkeyPatch, path: Path, code: str) -> None:
    """Let this interpreter run `code` in place of the worker."""
    path.write_text(code, encoding="utf-8")
    monkeypatch.setattr(reparam, "WORKER", path)
    monkeypatch.setattr(reparam, "environment", lambda: Path(sys.executable))


def request(**changes: object) -> reparam.Request:
    motion = perturb(scene_io.load_scene(SCENE, res=4), CUBE, (0, 0, 2))
    return reparam.Request(**{"scene": SCENE, "motion": motion, "integrator": {"max_depth": 2}, "spp": 4, **changes})


@pytest.mark.parametrize("filter_xml", ['<rfilter type="box"/>', '<rfilter type="$rfilter"/>',
                                        '<rfilter type="tent"><float name="radius" value="2"/></rfilter>'])  # fmt: skip
def test_other_filters_become_gaussian(filter_xml: str) -> None:
    xml = f'<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm">{filter_xml}</film></sensor></scene>'
    assert reparam.with_gaussian_filter(xml) == xml.replace(filter_xml, '<rfilter type="gaussian" />')


def test_a_gaussian_filter_keeps_its_width() -> None:
    xml = '<scene><rfilter type="gaussian"><float name="stddev" value="0.4" /></rfilter></scene>'
    assert reparam.with_gaussian_filter(xml) == xml


def test_gaussian_scene_takes_the_same_overrides(llvm: str) -> None:
    """Also one that only named the filter, which Mitsuba would refuse as unused."""
    film = reparam.gaussian_scene(SCENE, res=7, rfilter="tent").sensors()[0].film()
    assert "Gaussian" in str(film.rfilter()) and tuple(film.size()) == (7, 7)


def test_value_and_tangent_of_vertices_and_poses(llvm: str) -> None:
    """A translation has the same tangent everywhere; a matrix is given row by row."""
    scene = scene_io.load_scene(SCENE)
    value, tangent = reparam.value_and_tangent(perturb(scene, CUBE, (0, 0, 2)))
    np.testing.assert_allclose(value, np.array(mi.traverse(scene)[CUBE]), atol=1e-6)
    np.testing.assert_allclose(tangent.reshape(-1, 3), np.tile((0, 0, 2), (24, 1)), atol=1e-6)
    value, tangent = reparam.value_and_tangent(perturb(scene, "camera.to_world", (1, 0, 3)))
    np.testing.assert_allclose(value.reshape(4, 4)[:3, 3], (0, 0, 4), atol=1e-6)
    np.testing.assert_allclose(tangent.reshape(4, 4), [[0, 0, 0, 1], [0] * 4, [0, 0, 0, 3], [0] * 4], atol=1e-6)


def test_a_render_there_and_back(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker(monkeypatch, tmp_path / "echo.py", ECHO)
    found = reparam.render(request(load={"res": 4}))
    assert found.images.shape == (2, 1, 1, 3) and found.images.max() == 4
    assert found.seconds.tolist() == [0.5, 0.25] and found.warm_up_seconds == 1.5
    assert found.versions == {"integrator": "prb_reparam"}


@pytest.mark.parametrize(("status", "kind"), [(1, reparam.BaselineError), (reparam.CANNOT_START, SetupError)])
def test_a_failed_worker_is_a_typed_error(
    status: int, kind: type[Exception], llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker(monkeypatch, tmp_path / "fail.py", FAIL.format(status=status))
    with pytest.raises(kind, match=r"3\.4\.1.*: the cause$"):
        reparam.render(request())


def test_a_worker_that_hangs_is_ended(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker(monkeypatch, tmp_path / "hang.py", "import time\ntime.sleep(60)\n")
    with pytest.raises(reparam.BaselineError, match=r"0\.1 s"):
        reparam.render(request(timeout_seconds=0.1))


def test_counts_are_checked(llvm: str) -> None:
    with pytest.raises(OptionError, match="min_renders 9"):
        request(min_renders=9, max_renders=8)


def test_a_half_made_environment_is_made_anew(cache: Path, commands: list[list[str]]) -> None:
    leftover = cache / "lib" / "half"
    leftover.parent.mkdir(parents=True)
    leftover.touch()
    python = reparam.environment()
    assert len(commands) == 2 and "mitsuba==3.4.1" in commands[1] and "--only-binary=:all:" in commands[1]
    assert not leftover.exists() and reparam.is_complete(cache)
    assert reparam.environment() == python and len(commands) == 2


def test_an_installation_that_fails_leaves_no_stamp(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reparam, "find_python", lambda: sys.executable)
    monkeypatch.setattr(reparam.subprocess, "run", lambda *_, **__: reparam.subprocess.CompletedProcess(
        (), 1, "", "downloading\nERROR: no network"))  # fmt: skip
    with pytest.raises(SetupError, match=r"failed \(ERROR: no network\)"):
        reparam.environment()
    assert not reparam.is_complete(cache)


def test_missing_interpreters_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(reparam, "obstacle", lambda _: "is 3.14")
    with pytest.raises(SetupError, match=r"needs Python 3\.8 to 3\.12.*is 3\.14; python3\.12: not on PATH"):
        reparam.find_python()


def test_the_worker_needs_nothing_of_ours() -> None:
    """It runs on Python 3.8, next to another Mitsuba."""
    tree = ast.parse(reparam.WORKER.read_text(encoding="utf-8"), feature_version=(3, 8))
    imports = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    names = [node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in imports]
    assert set(names) <= ALLOWED


def test_requests_are_plain_json(llvm: str, tmp_path: Path) -> None:
    message = json.loads(json.dumps(reparam.message_for(request(load={"res": 4, "rfilter": "box"}), tmp_path / "out")))
    assert message["load"] == {"res": "4"} and message["param"] == CUBE and message["folder"] == str(SCENE.parent)
    assert message["integrator"] == {"type": "prb_reparam", "max_depth": 2}
