"""A case that fails, made smaller while it still fails: fewer things, simpler materials, shorter paths."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from typing import Any

from fuzz.scenes import Case

GREY = {"type": "diffuse", "reflectance": 0.5}
PLAIN_FILM = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "luminance", "rfilter": {"type": "box"}}


def shrunk(case: Case, fails: Callable[[Case], bool], seconds: float) -> Case:
    """The smallest case found in this time; `fails` says whether one still shows the defect.

    Greedy: the first change that keeps the failure is kept, and all changes are tried again.
    """
    end = time.perf_counter() + seconds
    progress = True
    while progress:
        progress = False
        for smaller in simpler(case):
            if time.perf_counter() > end:
                return case
            if fails(smaller):
                case, progress = smaller, True
                break
    return case


def simpler(case: Case) -> Iterator[Case]:
    """Cases with one thing less, the largest steps first."""
    scene, moved = case["scene"], case["param"].split(".")[0]
    lit = [name for name, item in scene.items() if isinstance(item, dict) and _shines(item)]
    for name, item in scene.items():
        needed = name in ("type", "camera", moved) or [name] == lit
        if not needed:
            yield _changed(case, lambda s, name=name: s.pop(name))
    depth = case["integrator"]["max_depth"]
    if depth > 1:
        yield {**copy.deepcopy(case), "integrator": {**case["integrator"], "max_depth": depth - 1}}
    if "hide_emitters" in case["integrator"] or case["integrator"]["rr_depth"] < depth:
        plain = {k: v for k, v in case["integrator"].items() if k != "hide_emitters"}
        yield {**copy.deepcopy(case), "integrator": {**plain, "rr_depth": 1000}}
    for name, item in scene.items():
        if isinstance(item, dict):
            yield from (_changed(case, change) for change in _simplifications(name, item, case["param"]))


def _simplifications(name: str, item: dict, param: str) -> Iterator[Callable[[dict], Any]]:
    """Changes of one thing in the scene that make it plainer and leave the parameter where it is."""
    if "bsdf" in item and item["bsdf"] != GREY and not param.startswith(f"{name}.bsdf"):
        yield lambda s: s[name].update(bsdf=GREY)
    if item.get("smooth"):
        yield lambda s: s[name].update(smooth=False)
    if item["type"] in ("thinlens", "orthographic") and param == "camera.to_world":
        steps = [step for step in item["to_world"] if step[0] != "scale"]
        yield lambda s: s.update({name: {"type": "perspective", "fov": 35, "film": item["film"], "to_world": steps}})
    if "film" in item and item["film"] != PLAIN_FILM:
        yield lambda s: s[name].update(film=PLAIN_FILM)
    if item["type"] == "envmap" and not param.startswith(f"{name}."):
        yield lambda s: s.update({name: {"type": "constant", "radiance": 0.5}})


def _shines(item: dict) -> bool:
    return "emitter" in item or item["type"] in ("point", "spot", "directional", "constant", "envmap")


def _changed(case: Case, change: Callable[[dict], Any]) -> Case:
    smaller = copy.deepcopy(case)
    change(smaller["scene"])
    return smaller
