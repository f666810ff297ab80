"""Timed renders of one method on one case. A method is a function from a seed to a derivative image."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

MIN_RENDERS, MAX_RENDERS = 4, 400  # memory: 400 images of 64² RGB are 40 MB
MIN_SLOW_RENDERS = 2  # the fewest that have a variance, for methods that need longer than the budget for one
QUICK_RENDER = 2.0  # [s] a first call shorter than this is followed by a second warm-up, which compiles again
FIRST_SEED = 1


class CannotRenderError(Exception):
    """A method does not do a case; the message goes into the row."""


@dataclass(frozen=True)
class Renders:
    """What `collect` found: images float64 (K, H, W, C), non-finite values as 0; seconds (K,)."""

    images: np.ndarray
    seconds: np.ndarray
    warm_up_seconds: float  # first call: tracing and compiling as well
    not_finite: int
    settings: dict[str, Any] = field(default_factory=dict)


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result of `call` and its seconds, with nothing pending before or after."""
    dr.eval()
    dr.sync_thread()
    start = time.perf_counter()
    result = call()
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def measured(work: Callable[[], Any]) -> tuple[float, float, int]:
    """Wall time [ms], time inside of kernels [ms] and number of kernel launches; needs `dr.JitFlag.KernelHistory`."""
    dr.eval()
    dr.sync_thread()
    dr.kernel_history_clear()
    _, seconds = timed(work)
    history = dr.kernel_history()
    return seconds * 1e3, sum(entry["execution_time"] for entry in history), len(history)


def collect(render: Callable[[int], tuple[np.ndarray, float]], budget: float, max_first: float) -> Renders:
    """Independent renders for `budget` seconds after warm-up, at least `MIN_RENDERS` of them.

    `render(seed)` returns an image and the seconds that count. A method whose first render takes longer than the
    budget gets `MIN_SLOW_RENDERS` more; longer than `max_first`: `CannotRenderError`.
    """
    _, first = render(FIRST_SEED)
    if first > max_first:
        raise CannotRenderError(f"one render takes {first:.0f} s, more than the {max_first:.0f} s allowed")
    if first < QUICK_RENDER:
        render(FIRST_SEED + 1)
    images, seconds = [], []
    fewest = MIN_RENDERS if first < budget else MIN_SLOW_RENDERS
    while len(images) < fewest or (sum(seconds) < budget and len(images) < MAX_RENDERS):
        image, took = render(FIRST_SEED + 2 + len(images))
        images.append(image)
        seconds.append(took)
    return finite(np.stack(images), np.array(seconds), first)


def finite(images: np.ndarray, seconds: np.ndarray, warm_up_seconds: float) -> Renders:
    """Renders whose non-finite values are counted and replaced by 0."""
    bad = ~np.isfinite(images)
    return Renders(np.where(bad, 0.0, images), seconds, warm_up_seconds, int(bad.sum()))
