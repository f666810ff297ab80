"""The README says what the code does: its generated blocks are current, and its example runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import psdr_jit
from psdr_jit.cli import main
from psdr_jit.driver.terms import TERMS
from psdr_jit.inverse import config
from psdr_jit.options import Options
from psdr_jit.scene.capabilities import support_table

ROOT = Path(psdr_jit.__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def block(name: str) -> str:
    return re.search(rf"<!-- {name}:begin[^>]*-->\n(.*?)\n<!-- {name}:end -->", TEXT, re.DOTALL)[1]


def test_support_table_is_what_the_code_checks():
    assert block("support") == support_table(), "run: python -m benchmarks.report"


def test_generated_blocks_are_current():
    command = [sys.executable, "-m", "benchmarks.report", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_terms_are_those_of_the_integrator():
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", TEXT, re.MULTILINE)
    assert rows == [(term.name, term.budget) for term in TERMS]


EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def run_example(text: str, names: dict | None = None) -> dict:
    names = {} if names is None else names
    exec(compile(text, "README.md", "exec"), names)
    return names


def test_python_example_runs(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    names = run_example(EXAMPLES[0])
    gradient = np.array(names["dr"].grad(names["params"]["small-box.vertex_positions"]))
    assert gradient.size == 24 and np.isfinite(gradient).all() and gradient.any()
    assert capsys.readouterr().out


def test_optimisation_examples_run(monkeypatch, tmp_path):
    """In Python, and from there on in PyTorch where it is installed."""
    monkeypatch.chdir(tmp_path)
    assert len(EXAMPLES) == 3
    names = run_example(EXAMPLES[1])
    assert names["result"].offsets["blocker.vertex_positions"]["distance"] < 0.05
    pytest.importorskip("torch")
    image = run_example(EXAMPLES[2], names)["image"]
    assert tuple(image.shape) == (32, 32, 3) and image.requires_grad


def test_configuration_example_is_right(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    (text,) = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "photo.exr").touch()
    (tmp_path / "shadow.xml").write_text((ROOT / "scenes" / "inverse" / "shadow.xml").read_text())
    (tmp_path / "config.toml").write_text(text)
    assert config.read(tmp_path / "config.toml").settings.iterations == 400


@pytest.mark.parametrize("path", sorted((ROOT / "scenes" / "inverse").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_configurations_are_right(path):
    assert config.read(path).variables


def test_xml_line_loads():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    (line,) = re.findall(r"```xml\n(.*?)\n```", TEXT, re.DOTALL)
    integrator = mi.load_string(line.replace("<integrator ", '<integrator version="3.0.0" ', 1))
    assert integrator.options == Options(max_depth=4)


@pytest.mark.parametrize("command", re.findall(r"^    \$? ?(?:\./)?psdr (\w+)", TEXT, re.MULTILINE))
def test_commands_exist(command):
    assert command in main.COMMANDS


def test_linked_files_exist():
    for target in re.findall(r"\]\(([\w/.]+)\)", TEXT):
        assert (ROOT / target).exists(), target


def test_no_paths_of_a_machine():
    assert not re.search(r"/(home|tmp|work|root|usr)/", TEXT)
