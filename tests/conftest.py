"""Variants to test in; backends that this machine lacks are skipped."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import pytest

import psdr_jit  # noqa: F401  (registers the plugins)

BACKENDS = {"llvm": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}


def activate(name: str) -> str:
    """Make `name` the active variant, or skip the test where its backend does not run."""
    if not dr.has_backend(BACKENDS[name.split("_")[0]]):
        pytest.skip(f"no backend for {name} on this machine")
    if name not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {name}")
    if mi.variant() != name:
        mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    return name


@pytest.fixture(autouse=True, scope="module")
def no_scenes_left() -> Iterator[None]:
    """Dr.Jit's virtual calls reach every scene that is alive, also one that waits in a reference cycle."""
    yield
    gc.collect()


@pytest.fixture(params=["llvm_ad_rgb", "cuda_ad_rgb"])
def variant(request) -> str:
    """Every backend with RGB; for whatever runs on the device."""
    return activate(request.param)


@pytest.fixture
def llvm() -> str:
    """RGB on the CPU, for what does not depend on the backend."""
    return activate("llvm_ad_rgb")
