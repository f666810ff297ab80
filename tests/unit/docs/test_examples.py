"""What the READMEs print can be done: snippets and commands are run, or parsed where running them takes long."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from benchmarks import run as bench
from psdr_jit.cli import main
from psdr_jit.inverse import config
from psdr_jit.options import Options

ROOT = Path(psdr_jit.__file__).resolve().parents[1]
PAGES = {name: (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "scenes/inverse/README.md")}
NOT_OURS = ("pip install .",)  # of other programs, and of the network
SHORT = ["params", "plan", "render"]  # commands that are run always
LONG = ["demo", "gradient", "optimize"]  # and only with the slow tests


def snippets(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


def printed() -> list[str]:
    """Command lines in blocks of code, in order, without comments."""
    found = []
    for text in PAGES.values():
        lines = re.findall(r"^    (?:\$ )?((?:\./psdr|psdr|pip|python) .*)$", text, re.MULTILINE)
        found += [re.sub(r"\s+#.*", "", line) for line in lines]
    return found


def mentioned() -> list[str]:
    """Command lines within sentences."""
    found = [span for text in PAGES.values() for span in re.findall(r"`((?:\./)?psdr [^`]+)`", text)]
    return list(dict.fromkeys(found))


OURS = list(dict.fromkeys(line.removeprefix("./") for line in printed() if line.removeprefix("./").startswith("psdr ")))


@pytest.fixture
def folder(llvm, monkeypatch, tmp_path) -> Path:
    """Where a user stands: an empty folder with the scenes in it."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_snippet(text: str, names: dict | None = None) -> dict:
    names = {} if names is None else names
    exec(compile(text, "README.md", "exec"), names)
    return names


def test_python_example_runs(folder, capsys):
    (text,) = snippets("README.md", "python")
    names = run_snippet(text)
    gradient = np.array(names["dr"].grad(names["params"]["small-box.vertex_positions"]))
    assert gradient.size == 24 and np.isfinite(gradient).all() and gradient.any()
    assert capsys.readouterr().out


def test_optimisation_examples_run(folder):
    """In Python, and from there on in PyTorch where it is installed."""
    first, second = snippets("scenes/inverse/README.md", "python")
    names = run_snippet(first)
    assert names["result"].offsets["blocker.vertex_positions"]["distance"] < 0.05
    pytest.importorskip("torch")
    image = run_snippet(second, names)["image"]
    assert tuple(image.shape) == (32, 32, 3) and image.requires_grad


def test_xml_line_loads(llvm):
    (line,) = snippets("README.md", "xml")
    integrator = mi.load_string(line.replace("<integrator ", '<integrator version="3.0.0" ', 1))
    assert integrator.options == Options(max_depth=4)


def test_toml_example_runs(folder, capsys):
    (text,) = snippets("scenes/inverse/README.md", "toml")
    (folder / "box.toml").write_text(text, encoding="utf-8")
    assert main.main(["optimize", "box.toml", "--iterations", "2"]) == 0
    assert "finished after 2 iterations" in capsys.readouterr().out
    assert (folder / "out/box/result.png").is_file()


@pytest.mark.slow
def test_toml_example_finds_the_box(folder):
    (text,) = snippets("scenes/inverse/README.md", "toml")
    (folder / "box.toml").write_text(text, encoding="utf-8")
    assert main.main(["optimize", "box.toml", "--quiet"]) == 0
    result = json.loads((folder / "out/box/result.json").read_text(encoding="utf-8"))
    assert result["offset"]["blocker.vertex_positions"]["distance"] < 0.01


@pytest.mark.parametrize("path", sorted((ROOT / "scenes" / "inverse").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_configurations_are_right(path):
    assert config.read(path).variables
    assert f"`{path.name}`" in PAGES["scenes/inverse/README.md"]


def test_there_are_commands_to_try():
    assert len(OURS) > 8 and len(mentioned()) > 8


@pytest.mark.parametrize("line", OURS)
def test_printed_commands_are_complete(line, monkeypatch):
    """Their options and values are those of the parsers, and the files that they name are there."""
    monkeypatch.chdir(ROOT)
    _, name, *rest = shlex.split(line)
    if name == "bench":
        bench.parser().parse_args(rest)
    elif name != "test":  # whose options are pytest's
        main.build_parser(name).parse_args([name, *rest])
    for word in rest:
        assert "/" not in word or word.startswith("out/") or Path(word).is_file(), word


@pytest.mark.parametrize("line", mentioned())
def test_mentioned_commands_exist(line, capsys):
    """Within sentences they are shortened: the command and its options count."""
    name, *rest = shlex.split(line)[1:]
    if name == "COMMAND":
        return
    if name == "bench":
        bench.parser().parse_args(rest)
        return
    with pytest.raises(SystemExit):
        main.main([name, "--help"])
    text = capsys.readouterr().out
    assert all(word in text for word in rest if word.startswith("--")), line


def test_other_commands_are_those_that_are_known():
    others = [line for line in printed() if not line.removeprefix("./").startswith("psdr ")]
    assert [line for line in others if not line.startswith("python -c ")] == list(NOT_OURS)


def test_scenes_can_be_copied(monkeypatch, tmp_path):
    (line,) = [line for line in printed() if line.startswith("python -c ")]
    done = subprocess.run([sys.executable, *shlex.split(line)[1:]], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "scenes/cbox.xml").is_file() and (tmp_path / "scenes/inverse/rotation.toml").is_file()


@pytest.mark.parametrize("line", [line for line in OURS if line.split()[1] in SHORT])
def test_short_commands_run(line, folder, capsys):
    assert main.main(shlex.split(line)[1:]) == 0
    assert capsys.readouterr().out


@pytest.mark.slow
def test_long_commands_run_one_after_the_other(folder):
    """As printed and in that order; --resume finds the run before it. No viewer is opened."""
    pytest.importorskip("rerun")
    (text,) = snippets("scenes/inverse/README.md", "toml")
    (folder / "box.toml").write_text(text, encoding="utf-8")
    for line in OURS:
        if line.split()[1] in LONG and "live" not in line.split():
            assert main.main(shlex.split(line)[1:]) == 0, line


def test_plan_is_what_is_printed(folder, capsys):
    """But for numbers that follow from noise, which rounding may change; those of edges do not."""
    (line, shown) = re.search(r"^    \$ (psdr plan .*)\n((?:    .*\n)+)", PAGES["README.md"], re.MULTILINE).groups()
    assert main.main(shlex.split(line)[1:]) == 0

    def words(text: str) -> list[list[str]]:
        lines = (line if " edges," in line else re.sub(r"[\d.]+", "0", line) for line in text.splitlines())
        return [line.split() for line in lines if line.strip()]

    assert words(capsys.readouterr().out) == words(shown)
