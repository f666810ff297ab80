"""What glass and mirrors gather, by `psdr_bdpt`: rough and smooth, below an area light, a spot and a point."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import mitsuba as mi

from benchmarks.check_lists.common import ALONG, Listed, Motion, T, glowing, ground, moved, scene_of, unit, view

NAME, METHOD = "caustics", "psdr_bdpt"
FLOOR = -0.9  # height
AT, CENTRE = (1.1, 2.6, 0.9), (0.05, 0.1, 0.1)  # of the light, of the body
DOWN = {"origin": list(AT), "target": list(CENTRE), "up": [0.2, 0.1, 1]}
UP = (0.1, 1.0, 0.05)
ALPHAS = (0.05, 0.1, 0.2)
STEP, STEP_OF_BODY = 0.01, 0.004  # a tenth of a pixel, but for what has outlines of its own
STEP_OF_SMOOTH = 0.002  # of the index of smooth glass: its caustic ends within a fraction of a pixel


def light(kind: str) -> dict:
    if kind == "point":
        return {"type": "point", "position": list(AT), "intensity": 14.0}
    pose = T().look_at(**DOWN)
    if kind == "spot":
        return {"type": "spot", "to_world": pose, "intensity": 20.0, "cutoff_angle": 28, "beam_width": 12}
    return glowing(pose.scale(0.12), 300.0)


def body(kind: str, bsdf: dict) -> dict:
    if kind == "ball":
        return {"type": "sphere", "center": list(CENTRE), "radius": 0.7, "bsdf": bsdf}
    pose = T().translate(list(CENTRE)).rotate(unit(0.3, 1, 0.2), 31).scale([0.9, 0.15, 0.7])
    return {"type": "cube", "to_world": pose, "bsdf": bsdf}


def scene(kind: str, bsdf: dict, lit: str) -> mi.Scene:
    """A body between a light and a floor."""
    camera = view((0.9, 2.3, 4.2), (0, -0.4, 0))
    parts = {"body": body(kind, bsdf), "floor": ground(FLOOR), "lamp": light(lit)}
    return scene_of(5, camera, METHOD, **parts)


def motions(kind: str, lit: str, of_index: float | None) -> Iterator[tuple[str, Motion]]:
    """`of_index`: step of the refractive index; None: there is none."""
    if of_index is not None:
        yield "index", Motion("body.bsdf.eta", of_index, 1.0)
    yield "light moved", moved("lamp.position" if lit == "point" else "lamp.to_world", ALONG, STEP)
    yield "body moved", moved("body.to_world" if kind == "ball" else "body.vertex_positions", ALONG, STEP_OF_BODY)
    yield "floor lifted", moved("floor.to_world", UP, STEP)


def caustics() -> Iterator[Listed]:
    for kind in ("slab", "ball"):
        for alpha in ALPHAS:
            glass = {"type": "roughdielectric", "alpha": alpha, "distribution": "ggx", "int_ior": 1.5}
            yield from _cases(f"rough glass {kind} {alpha}", kind, glass, ("area", "spot"), STEP)
    lights = ("area", "spot", "point")
    yield from _cases("smooth glass ball", "ball", {"type": "psdr_dielectric", "int_ior": 1.5}, lights, STEP_OF_SMOOTH)
    yield from _cases("mirror ball", "ball", {"type": "conductor"}, lights, None)


def _cases(
    name: str, kind: str, bsdf: dict[str, Any], lights: tuple[str, ...], of_index: float | None
) -> Iterator[Listed]:
    for lit in lights:
        for what, motion in motions(kind, lit, of_index):
            yield Listed(NAME, f"{name}, {lit}, {what}", partial(scene, kind, bsdf, lit), motion, method=METHOD)
