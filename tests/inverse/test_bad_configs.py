"""What is wrong with a problem is said before it runs, all at once, with the way out."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from inverse_problems import BOX, box_and_lamp, problem_of, scene_of, target_of, write_config

import psdr_jit
from psdr_jit import Parameter, Pose
from psdr_jit.cli import main
from psdr_jit.derivative import images
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse import config
from psdr_jit.inverse.problem import make_problem
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.targets import read_image


def test_every_mistake_of_a_file_is_reported_at_once(llvm, tmp_path):
    path = write_config(tmp_path, **{
        "spp = 4": "sppp = 4", "iterations = 20": "iterations = 0", "max_depth": "max_dept",
        "render = 64": "rendr = 64",
        "turn_rate = 1.0": "turnrate = 1.0", 'kind = "parameter"': 'kind = "params"',
        "learning_rate = 0.02": 'learning_rate = "fast"', "res = 16": "res = 16\n[[targets]]",
    })  # fmt: skip
    with pytest.raises(OptionError) as caught:
        config.read(path)
    text = str(caught.value)
    for words in ("9 mistakes", "'sppp'; did you mean 'spp'?", "iterations = 0", "'rendr'; did you mean 'render'?",
                  "either file or render", "'turnrate'; did you mean 'turn_rate'?", "kind = 'params'",
                  "learning_rate = 'fast': expected a number", "'max_dept'; did you mean 'max_depth'?",
                  "'targets'; did you mean 'target'?"):  # fmt: skip
        assert words in text, (words, text)


def test_files_that_are_not_there(llvm, tmp_path):
    for old, new, words in (('scene = "/', 'scene = "/nowhere', "there is no file"),
                            ("render = 64", 'file = "photo.exr"', "there is no file"),
                            ('scene = "', "scen = \"", 'scene = "..." is missing'),
                            ("[[target]]", "[target]", r"at least one \[\[target\]\]"),
                            ("iterations", "iterations =", "not valid TOML")):  # fmt: skip
        with pytest.raises(OptionError, match=words):
            config.read(write_config(tmp_path, **{old: new}))
    with pytest.raises(OptionError, match="is no file"):
        config.read(tmp_path / "missing.toml")


def test_values_of_another_type(llvm, tmp_path):
    for old, new, words in (
        ("[integrator]\nmax_depth = 2", "", None),
        ("[defaults]\nres = 16", "", None),
        ('kind = "pose"', 'kind = ["pose"]', "expected one of parameter, pose"),
        ("render = 64", "render = 64\nsensor = [[0]]", "an index or a list of them"),
        ("render = 64", 'render = 64\nsensor = "a"', "an index or a list of them"),
        ("render = 64", "render = 64.5", "expected a whole number"),
        ("lower = 0.5", 'lower = "0"', "expected a number"),
        ('turn_axes = "y"', "turn_axes = 3", "expected a text"),
        ("start_shift = [0.2, 0.0, -0.1]", 'start_shift = ["a", 0, 0]', "a list of three numbers"),
        ("start_at = 8.0", 'start_at = "bright"', "a number or a list of numbers"),
        ("seed = 7", "perturb = -1", "from 0 on"),
        ("seed = 7", "optimizer = 3", "its type must be one of"),
        ("seed = 7", 'optimizer = { type = "sgd", beta_1 = 0.9 }', "has no option 'beta_1'"),
        ("seed = 7", 'loss = ["l2"]', "expected one of l1"),
        ("iterations = 20", "iterations = 20.0", "expected a whole number"),
    ):
        path = write_config(tmp_path, **{old: new})
        if words is None:
            assert config.read(path).variables
            continue
        with pytest.raises(OptionError, match=words):
            config.read(path)
    for table in ("defaults", "integrator"):
        text = write_config(tmp_path).read_text().replace(f"[{table}]", f"[{table}s]")
        (tmp_path / "config.toml").write_text(f'{table} = "prb"\n' + text)
        with pytest.raises(OptionError, match=f"expected a table, .{table}"):
            config.read(tmp_path / "config.toml")


def test_properties_that_the_integrator_does_not_have(llvm, tmp_path):
    with pytest.raises(OptionError, match="max_dept"):
        config.problem_of(config.read(write_config(tmp_path, max_depth="max_dept")))


def test_targets(llvm, tmp_path):
    scene = scene_of()
    good = target_of(scene)
    nan = good.copy()
    nan[3, 4] = np.nan
    for target, words in (
        (good[:, :8], r"\(16, 8, 3\), but the sensor renders \(16, 16, 3\)"),
        (good[..., :1], "pixel format"),
        (nan, "3 of 768 values that are not finite"),
        ([], "no target"),
        (7, "must be an image"),
    ):
        with pytest.raises(ParameterError, match=words):
            psdr_jit.optimize(scene, box_and_lamp(), target)
    with pytest.raises(OptionError, match="no sensor 3"):
        psdr_jit.optimize(scene, box_and_lamp(), {3: good})
    with pytest.raises(OptionError, match="does not exist"):
        psdr_jit.optimize(scene, box_and_lamp(), "nowhere.exr")
    (tmp_path / "broken.exr").write_bytes(b"no image")
    with pytest.raises(OptionError, match="cannot be read"):
        psdr_jit.optimize(scene, box_and_lamp(), tmp_path / "broken.exr")


def test_target_files_are_read_as_linear_radiance(llvm, tmp_path):
    image = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    images.write_exr(tmp_path / "target.exr", {"image": image})
    assert np.allclose(np.array(read_image(tmp_path / "target.exr"))[..., :3], image)


def test_targets_with_aovs(llvm, tmp_path):
    """They have the channels of the integrator, by name: a file's alpha is no depth."""
    scene, integrator = scene_of(), {"type": "psdr_path", "max_depth": 2, "aovs": "dd:depth"}
    image = np.random.default_rng(0).random((16, 16, 4)).astype(np.float32)
    path = images.write_exr(tmp_path / "target.exr", {"primal": image}, aovs=["dd.T"])
    (problem_view,) = make_problem(scene, box_and_lamp(), path, "l2", integrator, Settings()).views
    assert np.array_equal(np.array(problem_view.target), image) and problem_view.aovs == ("dd.T",)
    with_aovs = write_config(tmp_path, max_depth='aovs = "dd:depth"\nmax_depth')
    assert config.problem_of(config.read(with_aovs)).views[0].target.shape == (16, 16, 4)
    mi.Bitmap(image).convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.UInt8, True).write(str(tmp_path / "a.png"))
    alpha = images.write_exr(tmp_path / "alpha.exr", {"primal": image})
    for target, error, words in (
        (image[..., :3], ParameterError, r"\(16, 16, 4\), the last of which are dd.T: .*, or aovs"),
        (tmp_path / "a.png", OptionError, "no channels dd.T: give an EXR file"),
        (alpha, OptionError, "the sensor renders R, G, B, dd.T"),
    ):
        with pytest.raises(error, match=words):
            psdr_jit.optimize(scene, box_and_lamp(), target, integrator=integrator)


def test_grey_target_files(llvm, tmp_path):
    """One channel, whatever its name, is grey; other files say what is missing and the way out."""
    values = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    grey, colour = tmp_path / "grey.exr", tmp_path / "colour.exr"
    images.write_exr(colour, {"image": values})
    for name in ("Y", "V", "depth.Z"):
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {name: values[..., 0].copy()}) as file:
            file.write(str(grey))
        assert np.array_equal(read_image(grey), np.repeat(values[..., :1], 3, axis=-1))
        assert np.array_equal(read_image(grey, channels=1), values[..., :1])
    assert np.allclose(read_image(colour, channels=1)[..., 0], values @ [0.2126, 0.7152, 0.0722], atol=1e-6)
    scene = scene_of()
    found = psdr_jit.optimize(scene, box_and_lamp(), grey, iterations=1, spp=1)
    assert found.status == "finished"
    odd = {"A": values[..., 0].copy(), "Z": values[..., 1].copy()}
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, odd) as file:
        file.write(str(grey))
    with pytest.raises(OptionError, match="channels A, Z, but the sensor renders R, G, B: .*pixel_format"):
        psdr_jit.optimize(scene, box_and_lamp(), grey)
    with pytest.raises(OptionError, match="R, G, B, A"):
        read_image(colour, channels=4)


def test_variables(llvm):
    for variables, error, words in (
        ([], OptionError, "no variable"),
        ([Pose(BOX, 0.1), Pose(BOX, 0.1)], OptionError, "several variables"),
        ([Pose("bloker.vertex_positions", 0.1)], ParameterError, "did you mean 'blocker.vertex_positions'"),
        ([Pose("lamp.intensity.value", 0.1)], ParameterError, "is no pose"),
        ([Pose(BOX, 0.1, shift_axes="")], OptionError, "neither shift nor turn"),
        ([Pose(BOX, 0.1, turn_axes="q")], OptionError, "letters out of xyz"),
        ([Pose(BOX, 0.1, turn_axes="y")], OptionError, "turn_rate"),
        ([Pose(BOX, 0.0)], OptionError, "must be above 0"),
        ([Pose("lamp.position", 0.1, turn_axes="y", turn_rate=1)], OptionError, "a point and cannot turn"),
        ([Pose("lamp.position", 0.1, pivot=(0, 0, 0))], OptionError, "a point and cannot turn"),
        ([Parameter("camera.near_clip", 0.1)], ParameterError, "cannot be differentiated"),
    ):
        with pytest.raises(error, match=words):
            psdr_jit.optimize(scene_of(), variables, np.zeros((16, 16, 3)))
    with pytest.raises(OptionError, match="'iteration'; there are"):
        psdr_jit.optimize(scene_of(), box_and_lamp(), np.zeros((16, 16, 3)), iteration=3)


def test_a_loss_of_many_numbers(llvm):
    problem = problem_of(loss=lambda image, target: image - target)
    with pytest.raises(ParameterError, match="768 numbers: expected one"):
        problem.apply(problem.start())
        problem.evaluate(0)


def test_exit_status_of_the_command(llvm, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(["optimize", "missing.toml"]) == 2
    assert "is no file" in capsys.readouterr().err
    path = write_config(tmp_path, 2)
    for wrong in ("--iterations=0", "--max-seconds=-1", "--perturb=-3"):
        assert main.main(["optimize", str(path), wrong]) == 2
        assert wrong.split("=")[0] in capsys.readouterr().err
    assert main.main(["optimize", str(path)]) == 0
    said = capsys.readouterr().out
    assert "finished after 2 iterations" in said and "distance from the scene file" in said
    assert (tmp_path / "out" / "config" / "result.png").is_file()


def test_ctrl_c_within_drjit_is_an_interruption(llvm, tmp_path, capsys, monkeypatch):
    """A second Ctrl-C arrives wherever it does; Dr.Jit wraps it."""

    def wrapped(*args):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("dr.while_loop(): encountered an exception (see above).") from error

    monkeypatch.setattr(config, "problem_of", wrapped)
    assert main.main(["optimize", str(write_config(tmp_path, 2)), "--out", str(tmp_path / "o")]) == 130
    assert "interrupted" in capsys.readouterr().err
