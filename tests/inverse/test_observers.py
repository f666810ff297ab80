"""Who looks at a run sees what it does, and does not disturb it; recordings are read back by Rerun's own reader."""

from __future__ import annotations

import re
import struct
import subprocess
import sysconfig
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from inverse_problems import BOX, box_and_lamp, problem_of, scene_of, target_of, write_config

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.core.sensor_frame import look_at, sensor_frame
from psdr_jit.errors import OptionError, PsdrError, SetupError
from psdr_jit.inverse import loop, stage
from psdr_jit.inverse.journal import Journal
from psdr_jit.inverse.observer import FRAMES, frame_due
from psdr_jit.inverse.problem import make_problem
from psdr_jit.inverse.settings import Settings

STEPS = 4


class Watcher:
    """Notes what it is shown, and where the scene's box is at that time."""

    def __init__(self) -> None:
        self.seen, self.centres, self.closed = [], [], None

    def begin(self, problem) -> None:
        self.problem = problem

    def centre(self) -> np.ndarray:
        return np.array(self.problem.params[BOX]).reshape(-1, 3).mean(0)

    def step(self, seen) -> None:
        self.seen.append(seen)
        self.centres.append(self.centre())

    def close(self, iteration: int) -> None:
        self.closed = (iteration, self.centre())


@pytest.mark.slow
def test_observers_see_where_the_images_were_taken(llvm):
    problem, watcher = problem_of(iterations=STEPS), Watcher()
    result = loop.run(problem, observers=[watcher])
    assert [s.iteration for s in watcher.seen] == list(range(STEPS))
    assert [s.loss for s in watcher.seen] == result.losses
    own = np.array([0, -0.2, 0])
    for seen, centre in zip(watcher.seen, watcher.centres, strict=True):
        assert np.linalg.norm(centre - own) == pytest.approx(seen.offsets[BOX]["distance"], rel=0.01)
    count, last = watcher.closed
    assert count == STEPS and np.linalg.norm(last - own) == pytest.approx(result.offsets[BOX]["distance"], rel=0.01)
    assert loop.run(problem_of(iterations=1)).losses == result.losses[:1], "looking on changes nothing"


class Rude(Watcher):
    """Fails when it is to close, and notes whether the log is closed by then."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def begin(self, problem) -> None:
        raise PsdrError("the first error")

    def close(self, iteration: int) -> None:
        self.closed = not (self.folder / "log.jsonl").exists()  # an empty one is removed when it is closed
        raise KeyError("rude")


def test_an_observer_that_fails_to_close_hides_nothing(llvm, tmp_path):
    """The log is closed, the others take their last look, and the error of the run is what is raised."""
    scene = scene_of()
    problem = make_problem(scene, box_and_lamp(), target_of(scene, spp=1), "l2", None, Settings(iterations=1, spp=1))
    rude, second = Rude(tmp_path), Watcher()
    second.begin(problem)
    with pytest.raises(KeyError, match="rude"):
        Journal(tmp_path, problem, 0, [rude, second]).close()
    assert rude.closed and second.closed[0] == 0
    second.closed = None
    with pytest.raises(PsdrError, match="the first error"):
        loop.run(problem, observers=[rude, second])
    assert second.closed[0] == 0


def two_scenes():
    """The box moves in both, a lamp in the second."""
    scenes = [scene_of(f"inverse/lamp_{name}", res=8) for name in ("left", "right")]
    given = [psdr_jit.Stage(scene, target_of(scene, spp=1), name=name)
             for scene, name in zip(scenes, ("left", "right"), strict=True)]  # fmt: skip
    variables = [psdr_jit.Pose(BOX, 0.02), psdr_jit.Pose("right:floor.to_world", 0.02)]
    return make_problem(given, variables, None, "l2", {"type": "psdr_path", "max_depth": 2}, Settings(spp=1))


def test_what_moves_in_several_scenes(llvm):
    problem = two_scenes()
    assert stage.moving(problem) == {"left_blocker", "right_blocker", "right_floor"}
    bodies = stage.bodies(problem)
    assert stage.moving(problem) < set(bodies) and "left_floor" in bodies
    assert bodies["left_blocker"] is not bodies["right_blocker"]


@pytest.mark.slow
def test_a_recording_holds_every_scene(llvm, tmp_path):
    pytest.importorskip("rerun", reason="the package rerun-sdk is not installed")
    view = psdr_jit.LiveView(tmp_path / "run.rrd")
    view.begin(two_scenes())
    view.close(1)
    rows = chunks(tmp_path / "run.rrd")
    shapes = {name: rows.get(f"world/shapes/{name}") for name in ("left_blocker", "right_blocker", "left_floor")}
    assert shapes == {"left_blocker": 1, "right_blocker": 1, "left_floor": 1}
    assert rows["world/cameras/left_camera"] == rows["world/cameras/right_camera"] == 1


def test_a_run_that_cannot_begin_leaves_no_event_file(llvm, tmp_path):
    pytest.importorskip("tensorboardX", reason="the package tensorboardX is not installed")
    config, logs = write_config(tmp_path, **{"blocker.vertex_positions": "blocker.vertex_position"}), tmp_path / "logs"
    assert main(["optimize", str(config), "--out", str(tmp_path / "out"), "--tensorboard", str(logs)]) == 2
    assert not list(logs.iterdir())


@pytest.mark.parametrize("make, missing, package", [(psdr_jit.LiveView, "rerun", "rerun-sdk"),
                                                    (psdr_jit.EventFiles, "tensorboardX", "tensorboardX")])  # fmt: skip
def test_missing_packages_are_named(monkeypatch, tmp_path, make, missing, package):
    monkeypatch.setitem(__import__("sys").modules, missing, None)
    with pytest.raises(SetupError, match=f"pip install {package}"):
        make(tmp_path / "a.rrd")


def test_frames_are_few():
    assert sum(frame_due(k, 10_000) for k in range(10_000)) <= FRAMES
    assert all(frame_due(k, FRAMES) for k in range(FRAMES))


def test_cameras_look_where_the_sensor_does(llvm):
    """A point of the world is projected to the same pixel by the camera's matrices and by the sensor."""
    sensor = scene_of().sensors()[0]
    found = stage.camera(sensor)
    point = np.array([0.1, 0.2, -0.15, 1.0])
    x, y, z, _ = np.linalg.inv(found.pose) @ point
    pixel = found.intrinsics @ np.array([-x / z, -y / z, 1])
    seen = look_at(sensor_frame(sensor), mi.Point3f(*point[:3].tolist()), mi.Point2f(0.5)).p
    assert np.allclose(pixel[:2], [float(seen.x[0]), float(seen.y[0])], atol=1e-3)
    assert np.ptp(pixel[:2]) > 0.1, "a transposed image would pass"


def chunks(path: Path) -> dict[str, int]:
    """Rows by entity of a recording, as `rerun rrd print` says."""
    rerun = Path(sysconfig.get_path("scripts")) / "rerun"
    subprocess.run([rerun, "rrd", "verify", path], check=True, capture_output=True)
    said = subprocess.run([rerun, "rrd", "print", path], check=True, capture_output=True, text=True).stdout
    rows: dict[str, int] = {}
    for count, entity in re.findall(r"^Chunk\(\S+\) with (\d+) rows .*? - /(.*?) - data", said, re.MULTILINE):
        rows[entity] = rows.get(entity, 0) + int(count)
    return rows


@pytest.mark.slow
def test_a_recording_holds_the_run(llvm, tmp_path):
    pytest.importorskip("rerun", reason="the package rerun-sdk is not installed")
    path = tmp_path / "run.rrd"
    scene, integrator = scene_of(), {"type": "psdr_path", "max_depth": 2}
    result = psdr_jit.optimize(scene, box_and_lamp(), target_of(scene), integrator=integrator, iterations=STEPS, spp=4,
                               observers=[psdr_jit.LiveView(path)])  # fmt: skip
    rows = chunks(path)
    assert rows["loss"] == rows[f"offset/{BOX}/distance"] == rows[f"value/{BOX}/shift"] == STEPS
    assert rows["world/shapes/blocker"] == STEPS + 1, "each iteration, and where it is left"
    assert rows["world/shapes/floor"] == rows["targets/camera"] == 1, "what rests is there once"
    assert rows["world/cameras/camera"] == STEPS + 1, "images, and a camera that rests"
    rerun = Path(sysconfig.get_path("scripts")) / "rerun"
    said = subprocess.run([rerun, "rrd", "print", "-vvv", path], check=True, capture_output=True, text=True).stdout
    tables = [part for part in said.split("* entity_path: ") if part.startswith("/loss ")]
    found = sorted(re.findall(r"┆ (\d+)\s+┆ [\d:T.-]+\s+┆ \[([\d.e-]+)\]", "".join(tables)))
    assert [int(k) for k, _ in found] == list(range(STEPS))
    assert np.allclose([float(value) for _, value in found], result.losses, rtol=1e-6)
    with pytest.raises(OptionError, match="there already"):
        psdr_jit.LiveView(path)


@pytest.mark.slow
def test_the_command_line_records(llvm, tmp_path, capsys):
    pytest.importorskip("rerun", reason="the package rerun-sdk is not installed")
    config = write_config(tmp_path, iterations=2)
    path = tmp_path / "run.rrd"
    assert main(["optimize", str(config), "--out", str(tmp_path / "out"), "--rerun", str(path), "--quiet"]) == 0
    assert chunks(path)["loss"] == 2
    assert main(["optimize", str(config), "--out", str(tmp_path / "again"), "--rerun", str(path), "--quiet"]) == 2
    assert "there already" in capsys.readouterr().err
    assert main(["optimize", str(config), "--out", str(tmp_path / "again"), "--rerun", "run.mp4", "--quiet"]) == 2


def events(folder: Path) -> bytes:
    (file,) = folder.glob("events.out.tfevents.*")
    return file.read_bytes()


@pytest.mark.slow
def test_event_files_hold_curves_and_images(llvm, tmp_path):
    pytest.importorskip("tensorboardX", reason="the package tensorboardX is not installed")
    from tensorboardX.proto.event_pb2 import Event

    result = loop.run(problem_of(iterations=STEPS), observers=[psdr_jit.EventFiles(tmp_path / "logs")])
    raw, at, scalars, pictures = events(tmp_path / "logs"), 0, {}, []
    while at < len(raw):  # records: length, its checksum, an event, its checksum
        (size,) = struct.unpack_from("<Q", raw, at)
        event = Event.FromString(raw[at + 12 : at + 12 + size])
        at += size + 16
        for value in event.summary.value:
            if value.HasField("image"):
                pictures.append((value.tag, event.step, value.image.width))
            else:
                scalars.setdefault(value.tag, []).append((event.step, value.simple_value))
    assert [step for step, _ in scalars["loss"]] == list(range(STEPS))
    assert np.allclose([value for _, value in scalars["loss"]], result.losses, rtol=1e-5)
    assert f"value/{BOX}/shift/0" in scalars
    assert pictures == [("camera/target", 0, 16), *(("camera/image", k, 16) for k in range(STEPS))]
