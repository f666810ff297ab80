"""Suite `accuracy`: error of the derivative image against time, for every case and method.

A row has the error curve of cumulative means, bias apart from variance, the gain (slope against the reference) and the
expected error after 10 s. The mean image of each method is stored for the charts, averaged over colour channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import cases, figures, methods, references, rows
from benchmarks.measure import Renders
from benchmarks.suites import REFERENCE, Settings
from psdr_jit.derivative.statistics import GroupedImages, gain

NAME = "accuracy"
BUDGET = 5.0  # [s]
RES = 64
LOAD = {"rfilter": "gaussian"}  # prb_reparam needs it, so everybody gets it
REFERENCE_BUDGETS = 4.0  # seconds of the reference in budgets
EQUAL_TIME = 10.0  # [s]
SLOWEST_FIRST_RENDER = 45.0  # [s]
GAIN_GROUPS = 32


@dataclass(frozen=True)
class Opened:
    """One case, loaded."""

    problem: methods.Problem
    settings: Settings


def case_names() -> list[str]:
    return [case.name for case in cases.CASES]


def quick_case_names() -> list[str]:
    return list(cases.QUICK)


def method_names(case: str) -> list[str]:
    return [REFERENCE, *(method.name for method in methods.METHODS)]


def open_case(name: str, settings: Settings) -> Opened:
    case = next(case for case in cases.CASES if case.name == name)
    load = {"res": RES, **LOAD}
    return Opened(methods.Problem(case, cases.load(case, RES, **LOAD), load), settings)


def measure(opened: Opened, method_name: str) -> dict[str, Any]:
    """The row of one method, without circumstances."""
    problem, settings = opened.problem, opened.settings
    if method_name == REFERENCE:
        return {**references.make(settings.folder, problem, REFERENCE_BUDGETS * settings.budget), "method": REFERENCE}
    method = methods.named(method_name)
    row, renders = methods.attempt(method, problem, settings.budget, SLOWEST_FIRST_RENDER)
    row = {"bench": NAME, **row}
    if renders is None:
        return row
    store_image(settings.folder, problem.case, method, renders)
    return {**row, **figures_of(renders, references.read(settings.folder, problem.case))}


def figures_of(renders: Renders, reference: figures.Reference) -> dict[str, Any]:
    """Everything that is said about a set of renders; squared errors relative to the power of the reference."""
    images, seconds = renders.images, renders.seconds
    power = reference.power
    bias2, bias2_stderr = figures.squared_bias(images, reference)
    spread = figures.variance(images)
    per_render = float(np.median(seconds))
    groups = GroupedImages(min(GAIN_GROUPS, len(images)))
    for image in images:
        groups.add(image)
    slope = gain(groups.group_means(), *(reference.groups or (reference.halves[:1], reference.halves[1:])))
    slope_stderr = float(np.hypot(slope.stderr_estimate, np.nan_to_num(slope.stderr_reference)))
    after = figures.mean_squared_error_after(EQUAL_TIME, per_render, bias2, spread)
    return {
        "seeds": len(images), "seconds": rows.summary(seconds), "warm_up_seconds": renders.warm_up_seconds,
        "curve": figures.error_curve(images, seconds, reference),
        "floor": float(np.sqrt(reference.squared_error / power)),
        "variance": spread / power, "bias2": bias2 / power, "bias2_stderr": bias2_stderr / power,
        "cost": spread * per_render / power, "error_10s": float(np.sqrt(after / power)),
        "gain": slope.value, "gain_stderr": slope_stderr,
        "tail_share": figures.tail_share(images),
        "not_finite": renders.not_finite, **renders.settings,
    }  # fmt: skip


def image_path(folder: Path, case: cases.Case) -> Path:
    return folder / "images" / f"{case.file_stem}.npz"


def store_image(folder: Path, case: cases.Case, method: methods.Method, renders: Renders) -> None:
    """Mean of as many renders as fit into the equal time, or of all if they took less."""
    path = image_path(folder, case)
    stored = dict(np.load(path)) if path.is_file() else {}
    fitting = max(1, int(EQUAL_TIME / np.median(renders.seconds)))
    stored[method.name] = renders.images[:fitting].mean((0, -1)).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **stored)
