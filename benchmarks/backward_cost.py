"""What a derivative costs: a backward pass against Mitsuba's primal `path`, and the interior term's variance.

    python -m benchmarks.backward_cost                  (minutes; append to benchmarks/results/backward_cost.jsonl)
    python -m benchmarks.backward_cost --out -          (print the rows instead)

The Cornell box, its small box's vertices enabled. The methods take turns within each round, so that a slow spell of
the machine hits all of them; the first rounds warm up caches and are dropped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import rows
from benchmarks.measure import measured
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.scene import io as scene_io

BENCH = "backward_cost"
PARAMETER = "small-box.vertex_positions"
PATHS = {"max_depth": 4, "rr_depth": 100}
LIFT = 0.06  # of the small box above the floor [scene units] in the placement "floating"
WARM_UP = 2  # rounds
QUIET = 0.5  # load average above which other processes disturb the measurement

METHODS = {
    "path (primal)": {"type": "path"},
    "psdr_path, every term": {"type": "psdr_path"},
    "psdr_path interior + primary": {"type": "psdr_path", "sppd": 0, "sppi": 0},
    "prb": {"type": "prb"},
    "prb_projective sppi=0, guiding none": {"type": "prb_projective", "sppi": 0, "guiding": "none"},
}
"""Name in the rows -> integrator. Budgets that are not 0 follow the runtime spp."""


def load(placement: str, res: int) -> Any:
    """The Cornell box as shipped ("contact": the box stands on the floor), or with the box lifted ("floating")."""
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=res, **PATHS)
    if placement == "floating":
        params = mi.traverse(scene)
        points = dr.unravel(mi.Point3f, params[PARAMETER])
        params[PARAMETER] = dr.ravel(points + mi.Vector3f(0, LIFT, 0))
        params.update()
    return scene


def runs(scene: Any, spp: int) -> dict[str, Callable[[int], Callable[[], Any]]]:
    """For each method: seed -> the work to be timed, all else prepared."""
    params = mi.traverse(scene)
    original = mi.Float(params[PARAMETER])
    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    grad_in = dr.full(mi.TensorXf, 1 / (width * height), (height, width, 3))
    dr.eval(grad_in)

    def attach(enabled: bool) -> None:
        value = mi.Float(original)
        dr.set_grad_enabled(value, enabled)
        params[PARAMETER] = value
        params.set_dirty(PARAMETER)
        params.update()
        dr.eval()

    def primal(integrator: Any) -> Callable[[int], Callable[[], Any]]:
        def prepare(seed: int) -> Callable[[], Any]:
            attach(False)
            return lambda: mi.render(scene, integrator=integrator, spp=spp, seed=seed)

        return prepare

    def backward(integrator: Any) -> Callable[[int], Callable[[], Any]]:
        def prepare(seed: int) -> Callable[[], Any]:
            attach(True)

            def work() -> Any:
                integrator.render_backward(scene, params, grad_in, seed=seed, spp=spp)
                return dr.grad(params[PARAMETER])

            return work

        return prepare

    built = {name: mi.load_dict({**PATHS, **spec}) for name, spec in METHODS.items()}
    return {name: (primal if "primal" in name else backward)(integrator) for name, integrator in built.items()}


def timing_rows(res: int, spp: int, count: int) -> list[dict[str, Any]]:
    """Cost of each method on the box in contact with the floor."""
    work = runs(load("contact", res), spp)
    samples: dict[str, list[tuple[float, float, int]]] = {name: [] for name in work}
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(WARM_UP + count):
            for name, prepare in work.items():
                sample = measured(prepare(seed))
                if seed >= WARM_UP:
                    samples[name].append(sample)
    settings = {"res": res, "spp": spp, **PATHS, "parameter": PARAMETER, "warm_up": WARM_UP}
    seeds = list(range(WARM_UP, WARM_UP + count))
    found = []
    for name, taken in samples.items():
        wall, kernel, launches = (rows.summary(column) for column in zip(*taken, strict=True))
        found.append({"bench": BENCH, "case": "cbox contact", "method": name, "settings": settings, "seeds": seeds,
                      "wall_ms": wall, "kernel_ms": kernel, "launches": launches["median"]})  # fmt: skip
    return found


def variance_row(placement: str, res: int, spp: int, seeds: int) -> dict[str, Any]:
    """Pixel variance of the interior term, derivative by moving the box along +x."""
    interior = mi.load_dict({"type": "psdr_path", **PATHS, "sppp": 0, "sppd": 0, "sppi": 0})
    sampler = DerivativeSampler(perturb(load(placement, res), PARAMETER, (1, 0, 0)), interior, spp=spp)
    images = np.stack([sampler.render(seed) for seed in range(seeds)])
    variance = images.var(axis=0, ddof=1).mean()
    halves = [half.var(axis=0, ddof=1).mean() for half in np.split(images, 2)]
    settings = {"res": res, "spp": spp, **PATHS, "parameter": PARAMETER, "direction": [1, 0, 0]}
    return {"bench": BENCH, "case": f"cbox {placement}", "method": "psdr_path interior: pixel variance",
            "settings": settings, "seeds": list(range(seeds)), "not_finite": sampler.not_finite,
            "variance": {"mean": variance, "halves": halves}}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default=str(rows.RESULTS / f"{BENCH}.jsonl"), help="file to append to, - to print")
    parser.add_argument("--runs", type=int, default=9, help="measured rounds (default: 9)")
    parser.add_argument("--res", type=int, default=128)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--variance-spp", type=int, default=16)
    parser.add_argument("--variance-seeds", type=int, default=16, help="an even number (default: 16)")
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    where = rows.circumstances()
    if where["load"] > QUIET:
        print(f"load average {where['load']:.1f} on {os.cpu_count()} cores: timings will be off", file=sys.stderr)
    found = timing_rows(args.res, args.spp, args.runs)
    found += [variance_row(p, args.res, args.variance_spp, args.variance_seeds) for p in ("contact", "floating")]
    for row in found:
        if args.out == "-":
            print(json.dumps({**row, **where}, default=float))
        else:
            rows.append(Path(args.out), {**row, **where})
    return 0


if __name__ == "__main__":
    sys.exit(main())
