"""Is every term right? `psdr gradient --check` on one scene per phenomenon, stored as rows.

    python -m benchmarks.checks                   (an hour; append to benchmarks/results/checks.jsonl)
    python -m benchmarks.checks --only cbox       (cases whose name contains a word)
    python -m benchmarks.checks --missing         (cases without a row that passed)
    python -m benchmarks.checks --list smooth     (instead, one of the lists of `check_lists`; hours on two cores)
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import rows
from benchmarks.check_lists import LISTS
from benchmarks.check_lists.common import Listed
from psdr_jit import check_gradient
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.scene import io as scene_io

BENCH = "checks"
LISTED = "check_lists"  # the same of the rows of lists
#: Standard error of the gain at which a case is decided; the rule asks for 0.007.
STDERR = 0.0068

X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)


@dataclass(frozen=True)
class Case:
    """A derivative of a shipped scene. `load`: overrides of its defaults; `eps`: None leaves the step to the check."""

    name: str
    scene: str
    param: str
    direction: Any = None
    rotate: Any = None
    load: dict = field(default_factory=dict)
    eps: float | None = None


def cornell(what: str, depth: int, lift: float) -> Case:
    load = {"res": 48, "max_depth": depth, "rr_depth": 100, "lift": lift}
    return Case(f"cbox {what}, depth {depth}", "cbox", "small-box.vertex_positions", X, load=load)


CASES = (
    Case("area shadow", "area_shadow", "blocker.vertex_positions", X),
    Case("point light shadow", "point_shadow", "blocker.vertex_positions", X),
    Case("spot light shadow", "spot_shadow", "blocker.vertex_positions", X),
    Case("directional light shadow", "directional_shadow", "blocker.to_world", X),
    Case("constant light, depth 3", "constant_shadow", "blocker.vertex_positions", X),
    Case("environment map, depth 3", "environment_shadow", "blocker.vertex_positions", X),
    Case("moving light", "area_shadow", "light.to_world", X),
    Case("moving receiver", "area_shadow", "floor.to_world", Y),
    Case("flat sphere rotated", "faceted_ball", "blocker.vertex_positions", rotate=(1, 1, 0)),
    Case("smooth sphere moved", "smooth_ball_shadow", "blocker.vertex_positions", X),
    Case("analytic sphere", "ball_shadow", "blocker.to_world", X),
    Case("analytic cylinder", "tube_shadow", "blocker.to_world", X),
    Case("seamed cube", "seamed_cube", "cube.vertex_positions", rotate=(0, 1, 0.3)),
    *(cornell("floating", depth, 0.06) for depth in (2, 3, 4, 6)),
    *(cornell("contact", depth, 0.0) for depth in (2, 3, 4, 6)),
    *(cornell("sunk", depth, -0.01) for depth in (2, 3, 4, 6)),
    Case("box sunk into a floor", "sunk_box", "box.vertex_positions", X),
    Case("box sunk deeper", "sunk_box", "box.vertex_positions", Y),
    Case("ball sunk into a floor", "sunk_ball", "ball.to_world", X),
    Case("floor rising around a ball", "sunk_ball", "floor.to_world", Y),
    Case("glossy reflection, depth 3", "glossy_floor", "blocker.vertex_positions", X),
    Case("light behind a baffle, depth 3", "baffled_light", "blocker.vertex_positions", X),
    Case("camera moved, with shadows", "area_shadow", "camera.to_world", X),
    Case("thin lens, with shadows", "thinlens_shadow", "blocker.vertex_positions", X),
)


def load(case: Case | Listed) -> tuple[Perturbation, dict[str, Any]]:
    """The motion of a case in its scene, and what `check_gradient` and a row are told of it."""
    if isinstance(case, Listed):
        scene, how = case.scene(), case.motion
        told = {"eps": how.eps, "tolerance": case.tolerance, "max_stderr": case.stderr}
        return perturb(scene, how.param, how.direction, rotate=how.rotate), told
    scene = scene_io.load_scene(scene_io.shipped_scene(f"{case.scene}.xml"), **case.load)
    motion = perturb(scene, case.param, case.direction, rotate=case.rotate)
    return motion, {"eps": case.eps, "max_stderr": STDERR}


def check(case: Case | Listed, seconds: float, **samples: int) -> dict[str, Any]:
    """A row; `samples`: `spp` and `reference_spp` of `check_gradient`."""
    motion, told = load(case)
    found = check_gradient(motion.scene, motion, max_seconds=seconds, **told, **samples)
    v = found.verdict
    film = motion.scene.sensors()[0].film().crop_size()
    if isinstance(case, Listed):
        bench, about, method = LISTED, {"list": case.of, "max_stderr": case.stderr}, case.method
    else:
        bench, about, method = BENCH, {"scene": case.scene, **case.load}, "psdr_path"
    settings = {
        **about, "parameter": motion.name, "motion": found.direction, "res": int(film[0]), "spp": found.spp,
        "seeds": found.seeds, "reference_spp": found.reference_spp, "reference_seeds": found.reference_seeds,
        "eps": found.eps, "block": found.block,
    }  # fmt: skip
    return {
        "bench": bench, "case": case.name, "method": method, "settings": settings, "verdict": v.verdict,
        "reason": v.reason, "gain": v.gain, "gain_stderr": v.gain_stderr, "rms_z": v.rms_z, "max_z": v.max_z,
        "blocks": v.blocks, "seconds": found.seconds,
    }  # fmt: skip


def passed(path: Path) -> set[str]:
    """Cases whose newest row passed."""
    found = rows.latest(rows.read([path])) if path.exists() else []
    return {row["case"] for row in found if row["verdict"] == "pass"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="cases whose name contains it")
    parser.add_argument("--list", choices=LISTS, help="cases of this list")
    parser.add_argument("--share", default="0/1", metavar="I/N", help="every Nth case, from the Ith on (default: 0/1)")
    parser.add_argument("--spp", type=int, default=64, help="of the estimate (default: 64)")
    parser.add_argument("--reference-spp", type=int, help="of differences (default: as the check sees fit)")
    parser.add_argument("--missing", action="store_true", help="leave out what has a row that passed")
    parser.add_argument("--seconds", type=float, default=180, help="time limit of a case (default: 180)")
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    parser.add_argument("--out", type=Path, help="default: a file of benchmarks/results")
    args = parser.parse_args()
    out = args.out or rows.RESULTS / f"{LISTED if args.list else BENCH}.jsonl"
    scene_io.use_variant(args.variant)
    done = passed(out) if args.missing else set()
    cases: list[Case | Listed] = list(LISTS[args.list]() if args.list else CASES)
    first, step = (int(word) for word in args.share.split("/"))
    failed = 0
    for case in cases[first::step]:
        if args.only in case.name and case.name not in done:
            row = check(case, args.seconds, spp=args.spp, reference_spp=args.reference_spp)
            rows.append(out, {**row, **rows.circumstances()})
            failed += row["verdict"] != "pass"
            print(
                f"{case.name:48s} {row['verdict']:12s} gain {row['gain']:.4f} +- {row['gain_stderr']:.4f}  RMS z "
                f"{row['rms_z']:.2f}  max |z| {row['max_z']:.1f}  {row['seconds']:.0f} s  {row['reason']}",
                flush=True,
            )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
