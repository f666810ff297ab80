"""Variants to test in; backends that this machine lacks are skipped."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest
from variants import activate

import psdr_jit  # noqa: F401  (registers the plugins)
from psdr_jit.core import collection


@pytest.fixture(autouse=True, scope="module")
def no_scenes_left() -> Iterator[None]:
    """Dr.Jit's virtual calls reach every scene that is alive, also one that waits in a reference cycle."""
    yield
    gc.collect()


@pytest.fixture
def nothing_collected() -> Iterator[None]:
    """For `dr.freeze`: Dr.Jit ends the process when a scene is collected while a function is recorded.

    "enqueue_host_func(): this function cannot be recorded", thrown where Mitsuba releases Embree's scene; scenes that
    wait in a cycle, that of an earlier test's exception for instance, are collected at any time.
    """
    gc.collect()
    with collection.nothing_collected():
        yield


@pytest.fixture(params=["llvm_ad_rgb", "cuda_ad_rgb"])
def variant(request) -> str:
    """Every backend with RGB; for whatever runs on the device."""
    return activate(request.param)


@pytest.fixture
def llvm() -> str:
    """RGB on the CPU, for what does not depend on the backend (or by PSDR_TEST_BACKEND, see `variants`)."""
    return activate("llvm_ad_rgb")


@pytest.fixture
def mono() -> str:
    """Half the work of RGB; what moves is the same."""
    return activate("llvm_ad_mono")
