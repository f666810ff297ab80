"""What a derivative costs: a backward pass against Mitsuba's primal `path`, and the interior term's variance.

    python -m benchmarks.backward_cost                  (minutes; append to benchmarks/results/backward_cost.jsonl)
    python -m benchmarks.backward_cost --out -          (print the rows instead)

The Cornell box, its small box's vertices enabled, and a crowd of boxes, those of one. The methods take turns in each
round, so that a slow spell of the machine hits all of them; the first rounds warm up caches and are dropped.
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
CROWD = 100  # boxes
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


def crowd(res: int) -> Any:
    """A hundred boxes on a floor under a lamp: what every further shape costs."""
    rng, T = np.random.default_rng(0), mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": res, "height": res}
    look = T.look_at([0, -8, 5], [0, 0, 0], [0, 0, 1])
    boxes = {
        f"box{k}": {"type": "cube", "to_world": T.translate([*rng.uniform(-3, 3, 2), 0.15]).scale(0.1)}
        for k in range(CROWD)
    }
    return mi.load_dict({
        "type": "scene", "sensor": {"type": "perspective", "to_world": look, "film": film}, **boxes,
        "floor": {"type": "rectangle", "to_world": T.scale(10)},
        "lamp": {"type": "rectangle", "to_world": T.translate([0, 0, 6]).rotate([1, 0, 0], 180),
                 "emitter": {"type": "area", "radiance": 10.0}},
    }, optimize=False)  # fmt: skip


def runs(scene: Any, spp: int, parameter: str = PARAMETER) -> dict[str, Callable[[int], Callable[[], Any]]]:
    """For each method: seed -> the work to be timed, all else prepared."""
    params = mi.traverse(scene)
    original = mi.Float(params[parameter])
    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    grad_in = dr.full(mi.TensorXf, 1 / (width * height), (height, width, 3))
    dr.eval(grad_in)

    def attach(enabled: bool) -> None:
        value = mi.Float(original)
        dr.set_grad_enabled(value, enabled)
        params[parameter] = value
        params.set_dirty(parameter)
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
                return dr.grad(params[parameter])

            return work

        return prepare

    built = {name: mi.load_dict({**PATHS, **spec}) for name, spec in METHODS.items()}
    return {name: (primal if "primal" in name else backward)(integrator) for name, integrator in built.items()}


def timing_rows(case: str, scene: Any, parameter: str, spp: int, count: int) -> list[dict[str, Any]]:
    """Cost of each method on a scene."""
    work = runs(scene, spp, parameter)
    samples: dict[str, list[tuple[float, float, int]]] = {name: [] for name in work}
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(WARM_UP + count):
            for name, prepare in work.items():
                sample = measured(prepare(seed))
                if seed >= WARM_UP:
                    samples[name].append(sample)
    res = int(scene.sensors()[0].film().crop_size()[0])
    settings = {"res": res, "spp": spp, **PATHS, "parameter": parameter, "warm_up": WARM_UP}
    seeds = list(range(WARM_UP, WARM_UP + count))
    found = []
    for name, taken in samples.items():
        wall, kernel, launches = (rows.summary(column) for column in zip(*taken, strict=True))
        found.append({"bench": BENCH, "case": case, "method": name, "settings": settings, "seeds": seeds,
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
    found = timing_rows("cbox contact", load("contact", args.res), PARAMETER, args.spp, args.runs)
    found += timing_rows(f"{CROWD} boxes", crowd(args.res // 2), "box0.vertex_positions", args.spp // 4, args.runs)
    found += [variance_row(p, args.res, args.variance_spp, args.variance_seeds) for p in ("contact", "floating")]
    for row in found:
        if args.out == "-":
            print(json.dumps({**row, **where}, default=float))
        else:
            rows.append(Path(args.out), {**row, **where})
    return 0


if __name__ == "__main__":
    sys.exit(main())
