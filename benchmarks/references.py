"""Converged derivative images, stored with their provenance; what every method's error is measured against.

The reference is `psdr_path` with other seeds than any measurement, many times longer. That it is right is shown apart
from it: finite differences are one of the methods and agree with it (their gain is 1 within the error), as do closed
forms where there are any. Finite differences themselves converge too slowly to be the reference.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import rows
from benchmarks.cases import Case
from benchmarks.figures import Reference
from benchmarks.methods import OURS, Problem
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.sampler import DerivativeSampler

SPP = 64
FIRST_SEED = 1 << 20
GROUPS = 32
MIN_SEEDS = 32


def path_of(folder: Path, case: Case) -> Path:
    return folder / "references" / f"{case.file_stem}.npz"


def make(folder: Path, problem: Problem, seconds: float) -> dict[str, Any]:
    """Render for `seconds`, store the halves, return the row that describes them."""
    case = problem.case
    integrator = integrator_specs.build({"type": OURS.name, **case.limits})
    sampler = DerivativeSampler(problem.motion, integrator, 0, SPP, groups=GROUPS, first_seed=FIRST_SEED)
    start = time.perf_counter()
    while sampler.seeds < MIN_SEEDS or time.perf_counter() - start < seconds:
        sampler.add(4)
    images = sampler.images.group_means()
    halves = np.stack([images[0::2].mean(0), images[1::2].mean(0)])
    reference = Reference(halves, float(np.mean(sampler.images.stderr() ** 2)))
    settings = {**problem.load, **case.limits, "spp": SPP, "scene": case.scene, "parameter": case.param,
                "motion": problem.motion.label, "first_seed": FIRST_SEED}  # fmt: skip
    row = {
        "bench": "references", "case": case.name, "method": OURS.name, "settings": settings, "seeds": sampler.seeds,
        "rms": float(np.sqrt(max(reference.power, 0.0))), "rms_stderr": float(np.sqrt(reference.squared_error)),
        "mean": reference.mean.mean((0, 1)).tolist(), "not_finite": sampler.not_finite,
        "total_seconds": sampler.seconds,
    }  # fmt: skip
    path = path_of(folder, case)
    path.parent.mkdir(parents=True, exist_ok=True)
    provenance = json.dumps({**row, **rows.circumstances()}, default=float)
    np.savez_compressed(path, halves=halves.astype(np.float32), squared_error=reference.squared_error,
                        provenance=provenance)  # fmt: skip
    return row


def read(folder: Path, case: Case) -> Reference:
    with np.load(path_of(folder, case)) as stored:
        return Reference(stored["halves"].astype(np.float64), float(stored["squared_error"]))
