"""Counts that are too large, disks that are full, scenes without an end: typed errors, in the API and the commands."""

from __future__ import annotations

import errno
import os

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.derivative import images
from psdr_jit.errors import OptionError, StorageError
from psdr_jit.scene import io as scene_io

CARD = str(scene_io.shipped_scene("emissive_card.xml"))
MOVE = ("card.vertex_positions", (1, 0, 0))
GRADIENT = ["gradient", CARD, "--wrt", MOVE[0], "--direction", "1,0,0", "--quiet", "-o", "o.exr", "-D", "res=16"]
TOO_MANY = 100_000_000


@pytest.fixture(autouse=True)
def elsewhere(llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def card(**defaults):
    return scene_io.load_scene(CARD, res=16, **defaults)


def said_by(capsys, *argv):
    """Status and the only line on standard error."""
    status = main(list(argv))
    (line,) = capsys.readouterr().err.splitlines()
    return status, line


@pytest.mark.parametrize("argv", [
    [*GRADIENT, "--spp", str(TOO_MANY)], [*GRADIENT, "--spp", "99999999999"],
    ["render", CARD, "--spp", str(TOO_MANY)], ["render", CARD, "--spp", "99999999999"],
    ["render", CARD, "--variant", "scalar_rgb", "--spp", "99999999999"],
])  # fmt: skip
def test_commands_refuse_more_samples_than_a_render_can_take(capsys, argv):
    status, line = said_by(capsys, *argv)
    assert status == 2 and ("more than 2^32" in line or "below 2^31" in line)
    assert not os.listdir()


def test_python_refuses_them_too():
    scene, box = card(), psdr_jit.Pose(MOVE[0], 0.01)
    target = np.zeros((16, 16, 3))
    for call in (
        lambda: psdr_jit.gradient(scene, *MOVE, spp=TOO_MANY),
        lambda: psdr_jit.gradient(scene, *MOVE, spp=TOO_MANY, integrator="prb"),
        lambda: psdr_jit.check_gradient(scene, *MOVE, spp=TOO_MANY),
        lambda: psdr_jit.check_gradient(scene, *MOVE, reference_spp=TOO_MANY),
        lambda: psdr_jit.optimize(scene, box, target, spp=TOO_MANY),
        lambda: psdr_jit.optimize(scene, box, target, gradient_spp=TOO_MANY),
        lambda: mi.load_dict({"type": "psdr_path"}).render(scene, spp=TOO_MANY),
    ):
        with pytest.raises(OptionError, match="more than 2"):
            call()


class Full:
    """Refuses the n-th file that is flushed to the disk."""

    def __init__(self, monkeypatch, number):
        self.count = 0
        flush = os.fsync

        def fsync(handle):
            self.count += 1
            if self.count == number:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            flush(handle)

        monkeypatch.setattr(os, "fsync", fsync)


@pytest.mark.parametrize(("argv", "names"), [
    ([*GRADIENT, "--spp", "2", "--seeds", "2"], ["o.exr", "o.png"]),
    (["render", CARD, "--spp", "2", "-D", "res=16", "-o", "r.exr"], ["r.exr"]),
    (["render", CARD, "--spp", "2", "-D", "res=16", "-o", "r.png"], ["r.png"]),
])  # fmt: skip
def test_commands_on_a_full_disk(capsys, monkeypatch, argv, names):
    for k, name in enumerate(names):
        with monkeypatch.context() as patch:
            Full(patch, k + 1)
            status, line = said_by(capsys, *argv)
        assert status == 3 and f"'{name}' could not be written: No space left" in line
        assert sorted(os.listdir()) == names[:k]  # whole, or not there


def test_python_on_a_full_disk(monkeypatch):
    for write in (lambda: images.write_exr("a.exr", {"a": np.zeros((4, 4, 3))}),
                  lambda: images.write_derivative_png("a.png", np.zeros((4, 4, 3)))):  # fmt: skip
        with monkeypatch.context() as patch:
            Full(patch, 1)
            with pytest.raises(StorageError, match="No space left"):
                write()
        assert not os.listdir()
    assert issubclass(StorageError, OSError)


def test_an_image_whose_last_block_is_lost_is_noticed(monkeypatch):
    """OpenEXR reports success for small files on a full disk, of which nothing has arrived."""
    import OpenEXR

    whole = OpenEXR.File.write

    def truncated(self, path):
        whole(self, path)
        os.truncate(path, 0)

    monkeypatch.setattr(OpenEXR.File, "write", truncated)
    with pytest.raises(StorageError, match="a.exr"):
        images.write_exr("a.exr", {"a": np.zeros((4, 4, 3))})
    assert not os.listdir()


def test_a_scene_that_includes_itself(capsys):
    for name, other in (("self.xml", "self.xml"), ("a.xml", "b.xml"), ("b.xml", "a.xml")):
        with open(name, "w", encoding="utf-8") as file:
            file.write(f'<scene version="3.0.0"><include filename="{other}"/></scene>')
    status, line = said_by(capsys, "render", "self.xml")
    assert status == 2 and "self.xml includes self.xml); remove" in line.replace(os.getcwd() + "/", "")
    status, line = said_by(capsys, "params", "a.xml")
    assert status == 2 and "a.xml includes b.xml includes a.xml" in line.replace(os.getcwd() + "/", "")
    assert len(line.replace(os.getcwd(), "")) < 200


def test_one_seed_has_no_standard_error(capsys):
    assert main([arg for arg in [*GRADIENT, "--spp", "2", "--seeds", "1"] if arg != "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "nan" not in out and "two seeds or more" in out and "1 seed x 2 spp" in out


def test_results_print_one_line_a_term():
    result = psdr_jit.gradient(card(), *MOVE, spp=2, seeds=2)
    lines = repr(result).splitlines()
    assert len(lines) == 3 + len(result.terms) and max(map(len, lines)) < 120
    assert "array" not in repr(result) and all(any(line.split()[0] == t for line in lines) for t in result.terms)
    assert "array" not in repr(psdr_jit.check_gradient(card(), *MOVE, spp=1, max_seconds=0.01))


def test_a_plan_of_nothing_asks_for_a_parameter(capsys):
    status, line = said_by(capsys, "plan", CARD)
    assert status == 2 and "--wrt" in line and f"psdr params {CARD}" in line


def test_integrators_that_see_no_edges_are_said_to(capsys):
    loud = [word for word in GRADIENT if word != "--quiet"] + ["--spp", "4", "--seeds", "2"]
    for name, told in (("prb", True), ("psdr_path", False)):
        assert main([*loud, "--integrator", name]) == 0
        assert ("edges and shadows bring is missing" in capsys.readouterr().out) == told


def test_long_renders_are_taken_apart_for_ctrl_c(llvm):
    """Samples add up, seeds differ; dependent samples stay together."""
    from psdr_jit.cli.render import SLICE, slices

    def sensor(kind: str) -> mi.Sensor:
        film = {"type": "hdrfilm", "width": 1024, "height": SLICE // 4096}
        return mi.load_dict({"type": "perspective", "film": film, "sampler": {"type": kind, "sample_count": 16}})

    assert slices(sensor("independent"), 4, 7) == [(4, 7)]
    parts = slices(sensor("independent"), 0, 7)
    assert [spp for spp, _ in parts] == [4] * 4 and len({seed for _, seed in parts}) == 4
    assert [spp for spp, _ in slices(sensor("independent"), 6, 7)] == [4, 2]
    assert slices(sensor("multijitter"), 0, 7) == [(16, 7)]
