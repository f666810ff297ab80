"""Does the error keep falling? RMSE of a derivative image over three decades of samples, and its log-log slope.

    python -m benchmarks.convergence               (25 minutes; append to benchmarks/results/convergence.jsonl)

A mean over N independent renders is compared with a reference of at least 10 times the samples of the largest N, made
from other seeds; the reference agrees with finite differences (`benchmarks.checks`). A bias would show as a floor.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import rows
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.scene import io as scene_io

BENCH = "convergence"
X, Y = (1, 0, 0), (0, 1, 0)
DECADES = (1, 10, 100, 1000)  # renders
SPP = 4
REFERENCE_SPP, REFERENCE_RENDERS = 256, 160  # > 10 × 1000 × 4
FIRST_REFERENCE_SEED = 1 << 20


@dataclass(frozen=True)
class Case:
    name: str
    scene: str
    param: str
    direction: Any
    load: dict = field(default_factory=dict)


CASES = (
    Case("area shadow", "area_shadow", "blocker.vertex_positions", X),
    Case("constant light, depth 3", "constant_shadow", "blocker.vertex_positions", X),
    Case("box sunk into a floor", "sunk_box", "box.vertex_positions", Y),
    Case("thin lens, with shadows", "thinlens_shadow", "blocker.vertex_positions", X),
    Case("cbox contact, depth 4", "cbox", "small-box.vertex_positions", X, {"max_depth": 4, "rr_depth": 100}),
    Case("two mirrors, depth 6", "mirrors", "blocker.vertex_positions", X),
    Case("glass ball, depth 6", "glass", "body.to_world", X),
    Case("light in a mirror", "reflected_light", "mirror.to_world", X),
)


def errors(case: Case, res: int) -> dict[str, Any]:
    scene = scene_io.load_scene(scene_io.shipped_scene(f"{case.scene}.xml"), res=res, **case.load)
    motion = perturb(scene, case.param, case.direction)
    integrator = integrator_specs.build(integrator_specs.integrator_spec(scene, "psdr_path"))
    reference = DerivativeSampler(motion, integrator, 0, REFERENCE_SPP, groups=16, first_seed=FIRST_REFERENCE_SEED)
    reference.add(REFERENCE_RENDERS)
    truth = reference.images.mean()
    sampler = DerivativeSampler(motion, integrator, 0, SPP, groups=max(DECADES))
    sampler.add(max(DECADES))
    images = sampler.images.group_means()
    found = []
    for n in DECADES:
        means = images.reshape(-1, n, *images.shape[1:]).mean(axis=1)
        found.append(float(np.sqrt(np.mean((means - truth) ** 2))))
    slope = float(np.polyfit(np.log10(DECADES), np.log10(found), 1)[0])
    floor = float(np.sqrt(np.mean(reference.images.stderr() ** 2)))
    return {"rmse": found, "slope": slope, "reference_error": floor, "signal": float(np.sqrt(np.mean(truth**2)))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=32)
    parser.add_argument("--cases", metavar="A,B", default="", help="only cases whose name contains one of these words")
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    parser.add_argument("--out", type=Path, default=rows.RESULTS / f"{BENCH}.jsonl")
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    for case in (case for case in CASES if any(word in case.name for word in args.cases.split(","))):
        result = errors(case, args.res)
        settings = {"scene": case.scene, "parameter": case.param, "res": args.res, "spp": SPP, "renders": DECADES,
                    "reference_spp": REFERENCE_SPP, "reference_renders": REFERENCE_RENDERS, **case.load}  # fmt: skip
        row = {"bench": BENCH, "case": case.name, "method": "psdr_path", "settings": settings, **result}
        rows.append(args.out, {**row, **rows.circumstances()})
        print(f"{case.name:28s} slope {result['slope']:.3f}  RMSE {result['rmse']}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
