"""`PSDR_QUICK_COMPILE`: other kernels, kept apart from Dr.Jit's, and a warning wherever it cannot work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from psdr_jit.setup import quick_compile

PROGRAM = """
import {first}
import {second}
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
x = mi.Float(dr.arange(mi.UInt32, 100))
print(dr.sum(dr.select(x > 3, dr.sin(x) * dr.exp(-x), dr.cos(x))))
"""


def run(home: Path, first: str, second: str, **variables: str) -> tuple[float, str]:
    """What the program prints, and what it says on the other stream."""
    unwanted = (quick_compile.VARIABLE, quick_compile.CACHE_VARIABLE)
    kept = {name: value for name, value in os.environ.items() if name not in unwanted}
    program = PROGRAM.format(first=first, second=second)
    child = subprocess.run(
        [sys.executable, "-c", program],
        env={**kept, "HOME": str(home), **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    return float(child.stdout.strip("[]\n")), child.stderr


def kernels(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.glob("*.bin")} if folder.is_dir() else {}


def test_kernels_are_others_and_elsewhere(tmp_path):
    slow, said = run(tmp_path, "psdr_jit", "mitsuba")
    quick, said_too = run(tmp_path, "psdr_jit", "mitsuba", PSDR_QUICK_COMPILE="1")
    assert slow == pytest.approx(quick, rel=1e-5)
    assert "no effect" not in said + said_too
    usual, own = kernels(tmp_path / ".drjit"), kernels(tmp_path / quick_compile.CACHE_FOLDER)
    assert usual
    assert usual.keys() == own.keys()  # the same source
    assert usual != own


def test_nothing_happens_unasked(tmp_path):
    run(tmp_path, "psdr_jit", "mitsuba", PSDR_QUICK_COMPILE="0")
    assert kernels(tmp_path / ".drjit")
    assert not kernels(tmp_path / quick_compile.CACHE_FOLDER)


def test_too_late_is_said(tmp_path):
    _, said = run(tmp_path, "mitsuba", "psdr_jit", PSDR_QUICK_COMPILE="1")
    assert "no effect: drjit was imported before psdr_jit" in said
    assert kernels(tmp_path / ".drjit")


def test_any_order_with_a_cache_of_the_user(tmp_path):
    cache = tmp_path / "mine"
    _, said = run(tmp_path, "mitsuba", "psdr_jit", PSDR_QUICK_COMPILE="1", DRJIT_CACHE_DIR=str(cache))
    assert "no effect" not in said
    run(tmp_path, "psdr_jit", "mitsuba")
    assert kernels(cache) != kernels(tmp_path / ".drjit")


@pytest.mark.parametrize("library", [None, "", "/no/such/libLLVM.so", "libm.so.6"])
def test_what_is_no_llvm_is_said(library):
    assert quick_compile.set_options(library) is not None


def test_a_child_says_otherwise():
    assert quick_compile.of_child({})[quick_compile.CACHE_VARIABLE].endswith(quick_compile.CACHE_FOLDER)
    assert quick_compile.of_child({quick_compile.VARIABLE: "0"}) == {quick_compile.VARIABLE: "0"}
    mine = {quick_compile.VARIABLE: "1", quick_compile.CACHE_VARIABLE: "here"}
    assert quick_compile.of_child(mine) == mine
