"""Pairs of scenes that look the same: what is derived of the one must be derived of the other.

No differences are taken, so nothing is left out between steps, and the noise is that of the derivative alone. Run as
`PYTHONPATH=tests:. python -m fuzz.alike FIRST COUNT [NAME...]`, a line for each seed and way to write a scene anew.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np
from fuzz.build import build, pose_of
from fuzz.scenes import Case, case_of
from fuzz.verdict import BLOCK, NOISY, REFUSED, RIGHT, SURE, TOLERANCE, VARIANT, WARNED, WRONG, Outcome

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.statistics import Unseen, block_means, block_test, gain
from psdr_jit.errors import PsdrError, UnsupportedWarning

SPP, SEEDS, LOOKS = 256, 16, (1, 4, 16)  # a look takes so many times the seeds of the first
GROUPS = 16
LARGER, SMALLER = 60.0, 0.2  # how many times
TURN, SHIFT = ["rotate", [0.3, 1.0, 0.2], 50], ["translate", [0.3, -0.2, 0.4]]
DEPTH = 0.6  # by which what stands on the floor is sunk into it, in units of its size
UPRIGHT = ("cube", "box", "prism")  # shapes whose sides are vertical if they stand
OPAQUE = ("diffuse", "roughconductor", "roughplastic", "principled", "twosided")


def _placed(case: Case) -> list[dict]:
    return [item for item in case["scene"].values() if isinstance(item, dict) and "to_world" in item]


def _is_shape(item: dict) -> bool:
    return item["type"] in ("rectangle", "disk", "sphere", "cylinder", "cube", "mesh")


def _times(factor: float, x: list) -> list:
    return [factor * float(v) for v in x]


def enlarged(factor: float) -> Callable[[Case], tuple[Case, float] | None]:
    """Everything so many times as large."""

    def of(case: Case) -> tuple[Case, float] | None:
        case = deepcopy(case)
        for item in _placed(case):
            aims = [step for step in item["to_world"] if step[0] == "look_at"]
            if _is_shape(item):
                item["to_world"].insert(0, ["scale", factor])
                continue
            for aim in aims:
                aim[1], aim[2] = _times(factor, aim[1]), _times(factor, aim[2])
            if item["type"] == "orthographic":
                item["to_world"][1][1] *= factor
        for item in case["scene"].values():
            if not isinstance(item, dict):
                continue
            if item["type"] in ("point", "spot"):
                item["intensity"] *= factor**2
            if item["type"] == "point":
                item["position"] = _times(factor, item["position"])
            for length in {"aperture_radius", "focus_distance"} & set(item):
                item[length] *= factor
        lengths = case["param"].endswith(("aperture_radius", "focus_distance")) or "index" in case["how"]
        if "direction" in case["how"]:
            case["how"]["direction"] = _times(factor, case["how"]["direction"])
        return case, factor if lengths else 1.0

    return of


def turned(case: Case) -> tuple[Case, float] | None:
    """Everything turned and moved together; not what moves along an axis, or turns about the middle of its box."""
    if "index" in case["how"] or ("rotate" in case["how"] and case["param"].endswith(".vertex_positions")):
        return None
    case = deepcopy(case)
    matrix = np.array(pose_of([SHIFT, TURN]).matrix, dtype=float)
    point = lambda x: (matrix[:3, :3] @ np.array(x, dtype=float) + matrix[:3, 3]).tolist()  # noqa: E731
    vector = lambda x: (matrix[:3, :3] @ np.array(x, dtype=float)).tolist()  # noqa: E731
    for item in _placed(case):
        if item["type"] == "envmap":
            item["to_world"].insert(0, TURN)
        elif _is_shape(item):
            item["to_world"][:0] = [SHIFT, TURN]
        else:
            for aim in (step for step in item["to_world"] if step[0] == "look_at"):
                aim[1:] = [point(aim[1]), point(aim[2]), vector(aim[3])]
    for item in case["scene"].values():
        if isinstance(item, dict) and item["type"] == "point":
            item["position"] = point(item["position"])
    for name in {"direction", "rotate"} & set(case["how"]):
        case["how"][name] = vector(case["how"][name])
    return case, 1.0


def divided(case: Case) -> tuple[Case, float] | None:
    """Faces of flat-shaded meshes cut into four; not what moves one vertex."""
    flat = [item for item in _placed(case) if item["type"] == "mesh" and not item["smooth"]]
    if not flat or "index" in case["how"]:
        return None
    case = deepcopy(case)
    for item in _placed(case):
        if item["type"] == "mesh" and not item["smooth"]:
            item["divided"] = True
    return case, 1.0


def _stands(case: Case, name: str) -> bool:
    """Is it an opaque thing with vertical sides on the floor, without texture?"""
    item = case["scene"][name]
    if not name.startswith("object") or item.get("mesh", item["type"]) not in UPRIGHT or item.get("smooth"):
        return False
    poses = [step[0] for step in item["to_world"]]
    upright = poses == ["translate", "rotate", "scale"] and item["to_world"][1][1] == [0, 1, 0]
    plain = "emitter" not in item and "texels" not in str(item) and item["bsdf"]["type"] in OPAQUE
    return upright and plain and item["to_world"][0][1][1] == item["to_world"][2][1]


def sunk(case: Case) -> tuple[Case, float] | None:
    """What stands on the floor reaches into it; things move along the floor only, in both scenes."""
    floor = case["scene"].get("floor")
    standing = [name for name in case["scene"] if name.startswith("object") and _stands(case, name)]
    if floor is None or floor.get("mesh") == "sheet" or not standing or "index" in case["how"]:
        return None
    if "direction" in case["how"]:
        case["how"]["direction"][1] = 0.0
    elif not case["param"].startswith("camera"):
        case["how"] = {"rotate": [0, 1, 0]} if "rotate" in case["how"] else case["how"]
    if case["param"].startswith("floor"):
        return None
    other = deepcopy(case)
    for name in standing:
        steps = other["scene"][name]["to_world"]
        (x, _, z), size = steps[0][1], steps[2][1]
        steps[0] = ["translate", [x, size * (1 - DEPTH / 2), z]]
        steps[2] = ["scale", [size, size * (1 + DEPTH / 2), size]]
    return other, 1.0


def as_meshes(case: Case) -> tuple[Case, float] | None:
    """Rectangles and cubes without texture as meshes; not what turns, as rectangles turn about their middle."""
    other, meshes = deepcopy(case), {"rectangle": "square", "cube": "box"}
    for name, item in other["scene"].items():
        if isinstance(item, dict) and item["type"] in meshes and "texels" not in str(item):
            if case["param"].startswith(f"{name}.") and not _is_moved(case):
                return None
            if case["param"] == f"{name}.to_world":
                other["param"] = f"{name}.vertex_positions"
            item |= {"type": "mesh", "mesh": meshes[item["type"]], "segments": 1, "smooth": False}
    return None if other == case else (other, 1.0)


def _is_moved(case: Case) -> bool:
    return "direction" in case["how"] or "to_world" not in case["param"] and "vertex" not in case["param"]


def tiled(case: Case) -> tuple[Case, float] | None:
    """The floor as two halves that meet."""
    floor = case["scene"].get("floor")
    if floor is None or floor["type"] != "rectangle" or "texels" in str(floor) or case["param"].startswith("floor"):
        return None
    other = deepcopy(case)
    for side in (-0.5, 0.5):
        half = deepcopy(floor)
        half["to_world"] += [["translate", [side, 0, 0]], ["scale", [0.5, 1, 1]]]
        other["scene"]["floor" if side < 0 else "floor2"] = half
    return other, 1.0


def otherwise(**options: Any) -> Callable[[Case], tuple[Case, float] | None]:
    """The same scene, another way to derive it."""

    def of(case: Case) -> tuple[Case, float] | None:
        other = deepcopy(case)
        other["integrator"] |= options
        return None if other == case else (other, 1.0)

    return of


def spatial_first(case: Case) -> tuple[Case, float] | None:
    """By the other form; the given one is the spatial one."""
    case["integrator"]["form"] = "spatial"
    return otherwise(form="material")(case)


WAYS: dict[str, Callable[[Case], tuple[Case, float] | None]] = {
    "larger": enlarged(LARGER), "smaller": enlarged(SMALLER), "turned": turned, "divided": divided, "sunk": sunk,
    "meshes": as_meshes, "tiled": tiled,
    "full plan": otherwise(plan="full"), "form": spatial_first,
}  # fmt: skip


def compare(case: Case, way: Callable[[Case], tuple[Case, float] | None]) -> Outcome | None:
    """Look at a case and at what looks the same, with more samples as long as they seem to differ; None: no such."""
    start, case = time.perf_counter(), deepcopy(case)
    changed = way(case)
    if changed is None:
        return None
    other, factor = changed
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UnsupportedWarning)
        try:
            samplers = [_sampler(other, 1), _known(json.dumps(case))]
            for sampler in samplers:
                sampler.add(max(0, 1 - sampler.seeds))
        except PsdrError as error:
            return Outcome(REFUSED, str(error), time.perf_counter() - start)
        missing = [str(w.message) for w in said if issubclass(w.category, UnsupportedWarning)]
    if missing:
        return Outcome(WARNED, missing[0], time.perf_counter() - start)
    for look in LOOKS:
        for sampler in samplers:
            sampler.add(max(0, SEEDS * look - sampler.seeds))
        word, text = _judge(*(sampler.images for sampler in samplers), factor)
        if word != WRONG:
            break
    return Outcome(word, text, time.perf_counter() - start)


@lru_cache(maxsize=2)
def _known(case: str) -> DerivativeSampler:
    """Of the case itself, with what it has rendered so far: each way to write it anew is compared with it."""
    return _sampler(json.loads(case), 0)


def _sampler(case: Case, number: int) -> DerivativeSampler:
    motion = perturb(build(case["scene"]), case["param"], **case["how"])
    integrator = integrator_specs.build(case["integrator"])
    return DerivativeSampler(motion, integrator, 0, SPP, groups=GROUPS, first_seed=5000 * number)


def _judge(other: Any, own: Any, factor: float) -> tuple[str, str]:
    d, f = factor * other.group_means(), own.group_means()
    slope = gain(d, f[::2], f[1::2])
    size = np.abs(block_means(f.mean(0), BLOCK)).max()
    test = block_test(d, f, BLOCK, Unseen(TOLERANCE * size / SURE))
    off = slope.has_signal and abs(slope.value - 1) > TOLERANCE + SURE * slope.stderr
    text = f"gain {slope.value:.4f} +- {slope.stderr:.4f}, largest |z| {test.max_z:.1f}"
    if off or test.max_z > SURE:
        return WRONG, text
    return (RIGHT if slope.has_signal or not (d.any() or f.any()) else NOISY), text


def main(first: int, count: int, *names: str) -> None:
    for seed in range(first, first + count):
        for name in names or WAYS:
            outcome = compare(case_of(seed), WAYS[name])
            if outcome is not None:
                case = case_of(seed)
                what = f"{case['param']} {case['how']} depth {case['integrator']['max_depth']}"
                if outcome.word in (WARNED, REFUSED):
                    break
                print(f"{seed:5d} {name:10s} {outcome.seconds:6.1f} s  {outcome.word:10s} {what}: {outcome.text}",
                      flush=True)  # fmt: skip


if __name__ == "__main__":
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    main(*(int(word) for word in sys.argv[1:3]), *sys.argv[3:])
