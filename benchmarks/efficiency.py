"""Variance × seconds of a derivative image, against Mitsuba's `prb_projective` in its best configuration.

    python -m benchmarks.efficiency                (half an hour; append to benchmarks/results/efficiency.jsonl)
    python -m benchmarks.efficiency --only cbox    (cases whose name contains a word)
    python -m benchmarks.efficiency --ours         (psdr_path alone: a minute)

Forward mode, every term, equal samples per pixel. Variance is the mean over pixels and channels of the sample variance
between seeds, seconds the median of a call after warm-up. The gain is against finite differences: a method that leaves
something out has less variance, so a ratio means nothing where the gain is off.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import rows
from psdr_jit import integrators, scene_io
from psdr_jit.finite_differences import CentralDifference
from psdr_jit.perturbation import Perturbation, perturb
from psdr_jit.statistics import gain

BENCH = "efficiency"
X = (1, 0, 0)
REFERENCE_SECONDS = 20.0  # of finite differences, for the gain


@dataclass(frozen=True)
class Case:
    name: str
    scene: str
    param: str
    depth: int
    direction: Any = None
    rotate: Any = None
    load: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Method:
    """An integrator; `tuning` are attributes that its plugin does not read from XML."""

    name: str
    spec: dict
    seeds: int
    warm_up: int
    tuning: dict = field(default_factory=dict)


CASES = (
    Case("area shadow", "area_shadow", "blocker.vertex_positions", 2, X),
    Case("moving light", "area_shadow", "light.to_world", 2, X),
    Case("environment light", "environment_shadow", "blocker.vertex_positions", 3, X),
    Case("flat sphere rotated", "faceted_ball", "blocker.vertex_positions", 3, rotate=(1, 1, 0)),
    Case("cbox floating", "cbox", "small-box.vertex_positions", 4, X, load={"lift": 0.06}),
    Case("cbox contact", "cbox", "small-box.vertex_positions", 4, X),
)

PEER = {"type": "prb_projective"}
OURS = Method("psdr_path", {"type": "psdr_path"}, seeds=32, warm_up=3)
METHODS = (
    OURS,
    Method("prb_projective, guiding none", {**PEER, "guiding": "none"}, seeds=32, warm_up=3),
    Method("prb_projective, small octree", {**PEER, "guiding": "octree"}, seeds=12, warm_up=1,
           tuning={"proj_seed_spp": 16, "octree_extra_leaf_sample": 8, "octree_max_depth": 6}),
    Method("prb_projective, default octree", {**PEER, "guiding": "octree"}, seeds=4, warm_up=1),
)  # fmt: skip


def load(case: Case, res: int) -> Perturbation:
    scene = scene_io.load_scene(scene_io.shipped_scene(f"{case.scene}.xml"), res=res, **case.load)
    return perturb(scene, case.param, case.direction, rotate=case.rotate)


def path_lengths(case: Case) -> dict[str, int]:
    return {"max_depth": case.depth, "rr_depth": 100}


def images(motion: Perturbation, method: Method, case: Case, spp: int) -> tuple[np.ndarray, list[float]]:
    """Derivative images (seeds, H, W, C) and the seconds of each call."""
    integrator = mi.load_dict({**method.spec, **path_lengths(case)})
    for name, value in method.tuning.items():
        setattr(integrator, name, value)
    sensor = motion.scene.sensors()[0]
    found, seconds = [], []
    for seed in range(method.warm_up + method.seeds):
        motion.attach()
        dr.eval()
        dr.sync_thread()
        start = time.perf_counter()
        image = integrator.render_forward(motion.scene, motion.params, sensor=sensor, seed=seed, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        if seed >= method.warm_up:
            seconds.append(time.perf_counter() - start)
            found.append(integrators.to_image(dr.detach(image)))
    return np.stack(found), seconds


def reference(motion: Perturbation, case: Case) -> CentralDifference:
    difference = CentralDifference(motion, {"type": "psdr_path", **path_lengths(case)}, 0, 256)
    while difference.seconds < REFERENCE_SECONDS:
        difference.add(2)
    return difference


def row(case: Case, method: Method, found: np.ndarray, seconds: list[float], halves, res: int, spp: int) -> dict:
    finite = np.isfinite(found)
    found = np.where(finite, found, 0)
    variance = found.var(axis=0, ddof=1).mean()
    time_of = rows.summary(seconds)
    slope = gain(found, *halves)
    settings = {"res": res, "spp": spp, **path_lengths(case), "parameter": case.param, **case.load, **method.tuning}
    return {
        "bench": BENCH, "case": case.name, "method": method.name, "settings": settings, "seeds": method.seeds,
        "variance": float(variance), "seconds": time_of, "cost": float(variance * time_of["median"]),
        "gain": slope.value, "gain_stderr": slope.stderr, "not_finite": int((~finite).sum()),
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="cases whose name contains it")
    parser.add_argument("--ours", action="store_true", help="no peers")
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    parser.add_argument("--out", type=Path, default=rows.RESULTS / f"{BENCH}.jsonl")
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    warnings.simplefilter("ignore")
    mi.set_log_level(mi.LogLevel.Error)
    for case in (c for c in CASES if args.only in c.name):
        motion = load(case, args.res)
        halves = [half.group_means() for half in reference(motion, case).halves]
        for method in (OURS,) if args.ours else METHODS:
            found, seconds = images(motion, method, case, args.spp)
            result = row(case, method, found, seconds, halves, args.res, args.spp)
            rows.append(args.out, {**result, **rows.circumstances()})
            cost, median = result["cost"], result["seconds"]["median"]
            print(
                f"{case.name:20s} {method.name:32s} variance {result['variance']:.2e} x {median:.3f} s = {cost:.2e}"
                f"   gain {result['gain']:.3f} +- {result['gain_stderr']:.3f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
