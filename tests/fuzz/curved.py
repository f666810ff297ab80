"""Random scenes with SDF grids, curves, ellipsoids and instances: those of `scenes`, with other shapes.

A stream of its own, so that the scenes without them stay what they are. These shapes cut into nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fuzz.draw import Draw
from fuzz.scenes import Case, case_of

SALT = 0xC04E  # keeps these streams apart from others with the same seeds
SHARE = 0.6  # of the objects; of each scene, one at least
FINE = (24, 32)  # values of a grid with blended normals; with fewer, it is named
ANY = (5, 8, 13)
RADIUS = 1.3  # within which a shape stays, in units of its size

Movable = list[tuple[str, dict]]


def curved_case_of(seed: int) -> Case:
    """The case of this seed, always the same: that of `case_of`, but that some objects are other shapes."""
    draw, case = Draw(np.random.default_rng([SALT, seed])), case_of(seed)
    scene = case["scene"]
    objects = [name for name in scene if name.startswith("object")]
    chosen = [name for name in objects if draw.chance(SHARE)] or objects[-1:]
    placed = [(scene[name]["to_world"][0][1], scene[name]["to_world"][-1][1]) for name in objects if name not in chosen]
    movable: Movable = []
    for name in chosen:
        size = draw.number(0.3, 0.6)
        centre = _place(draw, size, placed)
        placed.append((centre, size))
        make: Callable = draw.weighted({_grid: 3, _tube: 2, _rods: 2, _ellipsoids: 2, _instance: 1})
        made, ways = make(draw, name, np.array(centre), size)
        del scene[name]
        scene |= made
        movable += ways
    alive = case["param"].split(".")[0] in scene and case["param"].split(".")[0] not in chosen
    if movable and not (alive and draw.chance(0.4)):
        case["param"], case["how"] = draw.one(movable)
    elif not alive:
        case["param"], case["how"] = "camera.to_world", {"direction": draw.unit()}
    return case


def _place(draw: Draw, size: float, placed: list) -> list[float]:
    """Above the floor, and clear of what is there: the higher, the longer it takes to find a place."""
    height = 0.0
    while True:
        above = round(RADIUS * size + draw.number(0.05, 0.4) + height, 3)
        centre = [draw.number(-0.9, 0.9), above, draw.number(-0.9, 0.9)]
        if all(np.linalg.norm(np.subtract(centre, c)) > RADIUS * size + 1.8 * s for c, s in placed):
            return centre
        height += 0.02


def _bsdf(draw: Draw) -> dict:
    kind = draw.weighted({"diffuse": 2, "twosided": 2, "roughconductor": 1})
    if kind == "roughconductor":
        return {"type": kind, "alpha": draw.number(0.25, 0.6)}
    diffuse = {"type": "diffuse", "reflectance": draw.number(0.2, 0.8)}
    return diffuse if kind == "diffuse" else {"type": kind, "bsdf": diffuse}


def _grid(draw: Draw, name: str, centre: np.ndarray, size: float) -> tuple[dict, Movable]:
    """A bumpy ball or a ring."""
    normals = draw.one(["analytic", "smooth"])
    shape = {"type": "sdfgrid", "values": draw.one(FINE if normals == "smooth" else ANY), "normals": normals,
             "body": draw.one(["ball", "ring"]), "bumps": [draw.number(0, 0.12), draw.number(2, 5), draw.number(0, 6)],
             "to_world": [["translate", [round(float(c) - size, 3) for c in centre]], ["scale", 2 * size]],
             "bsdf": _bsdf(draw)}  # fmt: skip
    ways = [(f"{name}.to_world", {"direction": draw.unit()}), (f"{name}.grid", {})]
    return {name: shape}, ways


def _points(draw: Draw, centre: np.ndarray, size: float, count: int) -> list[list[float]]:
    """Control points that wind about an axis, so that the curve stays clear of itself, and radii."""
    turns = np.linspace(0, draw.number(2.5, 5), count) + draw.number(0, 6)
    along = np.linspace(-0.8, 0.8, count)
    p = np.stack([0.7 * np.cos(turns), along, 0.7 * np.sin(turns)], 1) + draw.rng.uniform(-0.08, 0.08, (count, 3))
    axis, angle = np.array(draw.unit()), draw.number(0, 6)
    p = p * np.cos(angle) + np.cross(axis, p) * np.sin(angle) + np.outer(p @ axis, axis) * (1 - np.cos(angle))
    radii = draw.rng.uniform(0.08, 0.18, (count, 1))
    return np.round(np.hstack([centre + size * p, size * radii]), 4).tolist()


def _tube(draw: Draw, name: str, centre: np.ndarray, size: float) -> tuple[dict, Movable]:
    count = draw.one([4, 6, 8])
    shape = {"type": "bsplinecurve", "points": _points(draw, centre, size, count), "bsdf": _bsdf(draw)}
    return {name: shape}, [(f"{name}.control_points", {"index": int(draw.rng.integers(4 * count))})] * 2


def _rods(draw: Draw, name: str, centre: np.ndarray, size: float) -> tuple[dict, Movable]:
    count = draw.one([2, 3, 5])
    shape = {"type": "linearcurve", "points": _points(draw, centre, size, count), "bsdf": _bsdf(draw)}
    return {name: shape}, [(f"{name}.control_points", {"index": int(draw.rng.integers(4 * count))})] * 2


def _ellipsoids(draw: Draw, name: str, centre: np.ndarray, size: float) -> tuple[dict, Movable]:
    """Two that do not touch."""
    apart = np.array(draw.unit())
    bodies = [
        [*np.round(centre + side * 0.65 * size * apart, 3).tolist(),
         *(round(size * draw.number(0.06, 0.19), 4) for _ in range(3)), *draw.unit(), draw.number(-1, 1)]
        for side in (-1, 1)
    ]  # fmt: skip
    shape = {"type": "ellipsoids", "bodies": bodies, "bsdf": _bsdf(draw)}
    return {name: shape}, [(f"{name}.data", {"index": int(draw.rng.integers(20))})] * 2


def _instance(draw: Draw, name: str, centre: np.ndarray, size: float) -> tuple[dict, Movable]:
    """It rests: only others move."""
    turn = ["rotate", draw.unit(), draw.number(0, 180, 1)]
    inner = {"type": draw.one(["cube", "sphere"]), "to_world": [["scale", 0.7]], "bsdf": _bsdf(draw)}
    group = {"type": "shapegroup", "inner": inner}
    steps = [["translate", [round(float(c), 3) for c in centre]], turn, ["scale", size]]
    return {f"{name}_group": group, name: {"type": "instance", "of": {"type": "ref", "id": f"{name}_group"},
                                           "to_world": steps}}, []  # fmt: skip
