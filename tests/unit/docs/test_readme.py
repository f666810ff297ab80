"""The READMEs say what the code does: generated blocks are current, links lead somewhere, it is short."""

from __future__ import annotations

import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

import psdr_jit
from psdr_jit.driver.terms import TERMS
from psdr_jit.scene.capabilities import support_table

ROOT = Path(psdr_jit.__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = (
    "README.md", "scenes/README.md", "scenes/inverse/README.md", "benchmarks/README.md", "benchmarks/results/README.md",
    "psdr_jit/cluster/README.md",
)  # fmt: skip
SHIPPED = ("README.md", "cbox.xml", "inverse/README.md", "inverse/rotation.toml", "meshes/box.obj")
LONGEST = 250  # lines that somebody reads who wants to know what this is
WIDEST = 120  # characters, as in the code; tables and pictures cannot be broken
CHARTS = 3


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


def test_it_is_short_and_begins_with_a_picture():
    lines = TEXT.splitlines()
    assert len(lines) <= LONGEST
    assert any(line.startswith("![") for line in lines[:10])


def test_figures_are_charts_with_a_sentence_each():
    """Tables are for the README of the results."""
    shown = block("bench")
    assert len(re.findall(r"^!\[.*\n\*\*\w+\.\*\* ", shown, re.MULTILINE)) == CHARTS
    assert "\n|" not in shown and "\n|" in (ROOT / "benchmarks/results/README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", ["README.md", "scenes/inverse/README.md"])
def test_lines_can_be_read_in_a_terminal(page):
    text = re.sub(r"<!-- (\w+):begin.*?:end -->", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert [line for line in text.splitlines() if len(line) > WIDEST and not line.startswith(("|", "!["))] == []


def anchors(text: str) -> set[str]:
    """What GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        assert not target.startswith("http"), "nothing checks links to elsewhere"
        name, _, anchor = target.partition("#")
        found = (ROOT / page).parent / name if name else ROOT / page
        assert found.exists(), target
        assert not anchor or anchor in anchors(found.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("page", PAGES)
def test_no_paths_of_a_machine(page):
    assert not re.search(r"/(home|tmp|work|root|usr)/", (ROOT / page).read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", SHIPPED)
def test_what_the_pages_name_is_installed_with_the_package(path):
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    patterns = re.findall(r'"([^"]+)"', re.search(r'^"psdr_jit\.scenes" = \[(.*)\]$', project, re.MULTILINE)[1])
    assert any(fnmatch(path, pattern) for pattern in patterns)
    assert psdr_jit.scene_io.shipped_scene(path).is_file()
