"""Mitsuba's variants, as far as this machine runs them.

PSDR_TEST_BACKEND=cuda has what runs with LLVM otherwise run on a device.
"""

from __future__ import annotations

import os

import drjit as dr
import mitsuba as mi
import pytest

BACKENDS = {"llvm": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}


IN_PLACE_OF_LLVM = os.environ.get("PSDR_TEST_BACKEND", "llvm")


def activate(name: str) -> str:
    """Make `name` the active variant, or skip the test where its backend does not run."""
    name = name.replace("llvm", IN_PLACE_OF_LLVM)
    if not dr.has_backend(BACKENDS[name.split("_")[0]]):
        pytest.skip(f"no backend for {name} on this machine")
    if name not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {name}")
    if mi.variant() != name:
        mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    return name


#: For tests that load such meshes.
needs_meshes_without_faces = pytest.mark.skipif(
    IN_PLACE_OF_LLVM == "cuda", reason="OptiX ends the process over meshes without faces"
)


def also(*values: object) -> object:
    """A case of the slow tests alone, in a list of `pytest.mark.parametrize`."""
    return pytest.param(*values, marks=pytest.mark.slow)
