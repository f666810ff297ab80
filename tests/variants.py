"""Mitsuba's variants, as far as this machine runs them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

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
