"""The commands render, gradient and params: what they write, what they say, and how they refuse."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest
from variants import activate

from psdr_jit.cli.main import main
from psdr_jit.derivative import finite_differences, images
from psdr_jit.scene import io as scene_io

CARD = str(scene_io.shipped_scene("emissive_card.xml"))
CBOX = str(scene_io.shipped_scene("cbox.xml"))
MOVE = ["--wrt", "card.vertex_positions", "--direction", "1,0,0"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Default output names are relative to the current folder."""
    monkeypatch.chdir(tmp_path)


def refused(capsys, *argv: str) -> str:
    """Run a command that must end with status 2 and write nothing; its message."""
    before = sorted(os.listdir())
    try:
        status = main(list(argv))
    except SystemExit as exit_:     # argparse
        status = exit_.code
    captured = capsys.readouterr()
    assert status == 2, captured
    assert sorted(os.listdir()) == before
    assert "Traceback" not in captured.err
    return captured.err


def test_gradient_writes_layers_and_png(capsys):
    assert main(["gradient", CARD, *MOVE, "--spp", "16", "--seeds", "4", "-o", "out.exr"]) == 0
    channels = images.read_exr("out.exr")
    layers = {name.rsplit(".", 1)[0] for name in channels if "." in name}
    assert layers == {"primal", "total", "total_stderr"} | {
        n + s for n in term_names() for s in ("", "_stderr")}
    total = np.stack([channels[f"total.{c}"] for c in "RGB"], -1)
    terms = sum(np.stack([channels[f"{n}.{c}"] for c in "RGB"], -1) for n in term_names())
    assert np.allclose(total, terms, atol=1e-4)
    # what enters on the right leaves on the left
    assert total[:, 16:].mean() > 0.1 and total[:, :16].mean() < -0.1
    assert sorted(os.listdir()) == ["out.exr", "out.png"]
    out = capsys.readouterr().out
    assert "card.vertex_positions" in out and all(n in out for n in term_names())


def term_names() -> list[str]:
    from psdr_jit.derivative.integrator_specs import term_table

    return [name for name, _ in term_table("psdr_path")]


def test_gradient_check_passes(capsys):
    brighter = ["--wrt", "card.emitter.radiance.value"]  # known precisely after few seeds
    check = ["gradient", CARD, *brighter, "--check", "--check-seconds", "24", "--quiet"]
    assert main(check) == 0
    assert main([*check, "--check-step", "0.02"]) == 0
    out = capsys.readouterr().out
    assert "PASS" in out and "terms in the estimate: interior" in out and "eps 0.02" in out


@pytest.mark.slow
def test_gradient_check_fails_with_status_1(capsys):
    """Mitsuba's prb has no boundary term."""
    argv = ["gradient", CARD, *MOVE, "--check", "--check-seconds", "30", "--integrator", "prb", "--quiet"]
    assert main(argv) == 1
    assert "FAIL" in capsys.readouterr().out


def test_gradient_check_out_of_time_is_inconclusive(capsys):
    tiny = ["--check-seconds", "0.01", "--spp", "1", "--seeds", "1", "--quiet"]
    assert main(["gradient", CARD, *MOVE, "--check", *tiny]) == 1
    assert "INCONCLUSIVE" in capsys.readouterr().out


def test_params_lists_verdicts(capsys):
    assert main(["params", CARD, "--all"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert " yes" in lines["camera.to_world"] and " no " in lines["card.faces"]
    assert main(["params", CARD]) == 0
    assert "card.faces" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_render(name):
    assert main(["render", CARD, "-o", name, "--spp", "4", "-D", "res=16", "--quiet"]) == 0
    assert os.listdir() == [name]
    if name == "a.exr":
        assert images.read_exr(name)["R"].shape == (16, 16)


def scene_with_mesh(mesh: str) -> str:
    text = ('<scene version="3.0.0"><sensor type="perspective"/><shape type="obj">'
            f'<string name="filename" value="{mesh}"/></shape></scene>')
    with open("scene.xml", "w") as file:
        file.write(text)
    return "scene.xml"


def test_missing_scene(capsys):
    assert "nope.xml' does not exist" in refused(capsys, "gradient", "nope.xml", *MOVE)
    assert "is a folder" in refused(capsys, "gradient", ".", *MOVE)


@pytest.mark.parametrize("content", [b'<scene version="3.0.0"><shape type="obj">', bytes(range(256)), b""])
def test_corrupt_scene(capsys, content):
    with open("bad.xml", "wb") as file:
        file.write(content)
    assert "bad.xml' cannot be loaded" in refused(capsys, "render", "bad.xml")


def test_missing_mesh(capsys):
    message = refused(capsys, "gradient", scene_with_mesh("nope.obj"), *MOVE)
    assert "nope.obj" in message and "not found" in message


def test_corrupt_mesh(capsys):
    with open("bad.obj", "w") as file:
        file.write("v 0 0\nf 1 2 9\n")
    assert "bad.obj" in refused(capsys, "gradient", scene_with_mesh("bad.obj"), *MOVE)


def test_scene_without_sensor(capsys):
    with open("s.xml", "w") as file:
        file.write('<scene version="3.0.0"><shape type="sphere"/></scene>')
    assert "<sensor>" in refused(capsys, "render", "s.xml")


@pytest.mark.parametrize("extra, words", [
    (["--wrt", "card.vertex_position"], "did you mean 'card.vertex_positions'"),
    (["--wrt", "card.faces"], "whole numbers"),
    (["--wrt", "camera.near_clip"], "plain Python float"),
    (["--wrt", "card.vertex_positions"], "needs a direction"),
    (["--wrt", "card.vertex_positions", "--direction", "1,0"], "three numbers"),
    (["--wrt", "card.vertex_positions", "--index", "99"], "outside"),
    ([*MOVE, "--rotate", "0,1,0"], "not allowed with"),
    ([*MOVE, "--spp", "0"], "--spp must be greater than 0"),
    ([*MOVE, "--seeds", "-1"], "--seeds must be greater than 0"),
    ([*MOVE, "--check-step", "0"], "--check-step must be greater than 0"),
    ([*MOVE, "--sensor", "3"], "no sensor 3"),
    ([*MOVE, "--variant", "nope"], "no variant 'nope'"),
    ([*MOVE, "--integrator", "nope"], "integrator 'nope'"),
    ([*MOVE, "-D", "res"], "NAME=VALUE"),
    ([*MOVE, "-D", "rez=3"], "rez"),
    ([*MOVE, "-o", "missing/a.exr"], "the folder 'missing' does not exist"),
])
def test_bad_input_is_refused(capsys, extra, words):
    assert words in refused(capsys, "gradient", CARD, *extra)


def test_scalar_variant_has_no_derivatives(capsys):
    argv = ["--wrt", "small-box.vertex_positions", "--direction", "1,0,0", "--variant", "scalar_rgb"]
    assert "does not track derivatives" in refused(capsys, "gradient", CBOX, *argv)


def test_scene_options_reach_the_integrator():
    """psdr_path takes over the scene's path lengths; --max-depth wins; the reference has the same ones."""
    from psdr_jit.derivative import integrator_specs

    activate("llvm_ad_rgb")
    scene = scene_io.load_scene(CBOX, max_depth=3, rr_depth=77)
    spec = integrator_specs.integrator_spec(scene)
    assert spec == {"type": "psdr_path", "max_depth": 3, "rr_depth": 77, "hide_emitters": False}
    assert integrator_specs.integrator_spec(scene, max_depth=5)["max_depth"] == 5
    assert integrator_specs.path_options(integrator_specs.build(spec))["rr_depth"] == 77
    reference = integrator_specs.reference({**spec, "max_depth": -1}, scene)
    assert integrator_specs.path_options(reference)["max_depth"] == -1
    own = scene_io.integrator_properties(CBOX, max_depth=3)
    assert own == {"type": "path", "max_depth": 3, "rr_depth": 5}


def test_demo_in_small(capsys, monkeypatch):
    """Every file is there, and a few steps bring the box nearer."""
    monkeypatch.setattr(finite_differences, "PATHS_PER_RENDER", 1 << 12)    # quick and noisy
    assert main(["demo", "--out", "o", "--res", "32", "--iterations", "8", "--quiet"]) == 0
    assert sorted(os.listdir("o")) == ["gradient.exr", "gradient.png", "recovery.png"]
    lines = capsys.readouterr().out.splitlines()
    start, result = (float(next(x for x in lines if w in x).split()[3]) for w in ("start  off", "result off"))
    assert result < 0.8 * start
    assert "finite_differences.R" in images.read_exr("o/gradient.exr")


def test_demo_cannot_make_its_folder(capsys):
    with open("file", "w"):
        pass
    assert "cannot make the folder" in refused(capsys, "demo", "--out", "file/sub")


@pytest.mark.parametrize("inside, colours", [('<integrator type="path" name="image"/>', "RGB"), ("", "")])
def test_channels_of_mitsubas_aov_have_their_names(tmp_path, inside, colours):
    text = open(CARD, encoding="utf-8").read()
    own = re.search(r"<integrator.*?</integrator>", text, re.DOTALL)[0]
    aov = f'<integrator type="aov"><string name="aovs" value="dd:depth,nn:sh_normal"/>{inside}</integrator>'
    scene = tmp_path / "aov.xml"
    mesh = str(scene_io.shipped_scene("meshes/card.obj"))
    scene.write_text(text.replace(own, aov).replace("meshes/card.obj", mesh), encoding="utf-8")
    assert main(["render", str(scene), "-D", "res=8", "--spp", "1", "-o", "a.exr", "--quiet"]) == 0
    channels = {name for name in images.read_exr("a.exr") if not name.startswith("primal.")}
    assert channels == {*colours, "dd.T", "nn.X", "nn.Y", "nn.Z"}
    assert main(["render", str(scene), "-D", "res=8", "--spp", "1", "-o", "a.png", "--quiet"]) == 0


@pytest.mark.parametrize("more, words", [
    (["-D", "size=3"], ("no <default name=\"size\">", "it has 'res'")),
    (["--integrator", "psdr"], ("no integrator 'psdr'", "psdr_path and psdr_bdpt")),
])  # fmt: skip
def test_names_that_are_not_there_are_answered_with_those_that_are(capsys, more, words):
    said = refused(capsys, "gradient", CARD, *MOVE, *more)
    assert all(word in said for word in words) and "Plugin" not in said


def test_reports_of_other_files_are_refused(capsys):
    assert "psdr gradient has written, or the folder of psdr optimize" in refused(capsys, "report", CARD)
