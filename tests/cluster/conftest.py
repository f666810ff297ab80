"""A scene, where it is from, and two workers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import pytest
from clusters import FILE, RES
from variants import activate

import psdr_jit
from psdr_jit.scene import io as scene_io


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    activate("llvm_ad_rgb")
    return scene_io.load_scene(FILE, **RES)


@pytest.fixture(scope="module")
def two() -> Iterator[Any]:
    """A client of two workers on this machine."""
    pytest.importorskip("distributed")
    from psdr_jit.cluster import engine

    with engine.local(2) as client:
        yield client


@pytest.fixture(scope="module")
def source() -> psdr_jit.SceneFile:
    return psdr_jit.SceneFile(FILE, RES)
