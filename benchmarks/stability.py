"""Suite `stability`: one thing at a time is driven towards where methods fail; the table shows where each breaks.

A step of a sweep is a case like any other. Its truth is a central difference of `path` of that very step, except where
a sweep says that all of its steps have one and the same derivative: size and place of the whole scene. There the first
step is the truth of all, in which no small number meets a large one. With the gaussian filter an image is a smooth
function of where an edge is, so that a difference over a tenth of a pixel is a derivative.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import cases, figures, meshes, methods, sweeps
from benchmarks.accuracy import LOAD, figures_of
from benchmarks.cases import BLOCKER, SMALL_BOX, Case, X
from benchmarks.suites import Settings
from benchmarks.sweeps import Sweep
from psdr_jit.derivative.finite_differences import CentralDifference

NAME = "stability"
BUDGET = 1.5  # [s]
RES = 32
REFERENCE_BUDGETS = 4.0
SLOWEST_FIRST_RENDER = 45.0  # [s]
METHODS = ("psdr_path", "prb_projective, no guiding")


def shadow(**load: Any) -> Case:
    return Case("", "stress_shadow", BLOCKER, 2, X, load=load)


def of_mesh(mesh: Callable[[], tuple]) -> Case:
    return replace(shadow(), mesh=mesh)


def cornell(depth: int, lift: float) -> Case:
    return Case("", "cbox", SMALL_BOX, depth, X, load={"lift": lift})


ORIGIN, TARGET = np.array([0.7, 2.2, 4.0]), np.array([0.0, -0.5, 0.0])
FLOOR, FLOOR_SIDE, DISTANCE = -1.0, 8.0, 4.0  # height and side of the floor; of the camera from the target
SQUARE_SHARE = 1 / 24  # of a square, by which differences move it at most: by a sixth of it, gains of 100 are 1.06


def written(**points: np.ndarray) -> dict[str, str]:
    """Points as a scene file has them."""
    return {name: ", ".join(f"{x:.9g}" for x in point) for name, point in points.items()}


def placed(size: float, shift: float) -> Case:
    """The whole scene, camera included, scaled and then moved along x; the motion is scaled as well."""
    text = written(origin=ORIGIN * size + [shift, 0, 0], target=TARGET * size + [shift, 0, 0])
    lengths = {"size": size, "shift": shift, "near": 0.01 * size, "far": 1e4 * size}
    return replace(shadow(**text, **lengths), direction=(size, 0, 0))


def seen_from(degrees: float) -> Case:
    """Camera at an elevation over the floor, at which it looks where the shadow falls."""
    angle = np.deg2rad(degrees)
    target = np.array([0.0, FLOOR, 0.0])
    origin = target + DISTANCE * np.array([0.0, np.sin(angle), np.cos(angle)])
    return shadow(**written(origin=origin, target=target))


def lit_from(degrees: float) -> Case:
    horizontal = np.hypot(0.3, 0.2)
    load = {"down": -horizontal * np.tan(np.deg2rad(degrees))}
    return Case("", "directional_shadow", "blocker.to_world", 2, X, load=load)


def smooth(segments: float) -> Case:
    """A smooth-shaded ball of so many segments around."""
    ball = partial(meshes.ball, max(3, int(segments) // 2), int(segments))
    return Case("", "smooth_ball_shadow", BLOCKER, 2, X, mesh=ball)


def checkered(cells: float) -> Case:
    """Squares of a checkerboard per side of the floor, two to a period."""
    return Case("", "patterns", "floor.to_world", 2, X, load={"periods": cells / 2})


SWEEPS = (
    Sweep("contact distance", "height of the box [units]", (0.1, 0.01, 1e-3, 1e-4, 0.0, -1e-3, -0.01),
          lambda lift: cornell(3, lift)),
    Sweep("light size", "half side [units]", (0.4, 0.1, 0.03, 0.01, 0.001), lambda size: shadow(light_size=size)),
    Sweep("roughness", "alpha", (0.5, 0.2, 0.1, 0.05, 0.02),
          lambda alpha: Case("", "glossy_floor", BLOCKER, 3, X, load={"alpha": alpha})),
    Sweep("triangles", "count", (1e3, 1e4, 1e5, 1e6), lambda n: of_mesh(partial(meshes.round_ball, int(n)))),
    Sweep("nearly coplanar faces", "height of the bumps [edge lengths]", (1e-1, 1e-2, 1e-4, 1e-6, 0.0),
          lambda bulge: of_mesh(partial(meshes.box, 8, bulge))),
    Sweep("slivers", "triangles around a ball of 3 rings", (8, 64, 512, 4096),
          lambda n: of_mesh(partial(meshes.ball, 3, int(n)))),
    Sweep("grazing view", "elevation of the camera [degrees]", (45, 20, 10, 5, 2), seen_from),
    Sweep("grazing light", "elevation of the light [degrees]", (60, 30, 15, 8, 4), lit_from),
    Sweep("scene size", "factor", (1.0, 1e3, 10.0, 0.1, 0.01, 1e-3), lambda size: placed(size, 0.0), placed(1.0, 0.0)),
    Sweep("scene offset", "units", (0.0, 10.0, 100.0, 1e3, 1e4), lambda shift: placed(1.0, shift), placed(1.0, 0.0)),
    Sweep("smooth shading", "segments around a ball", (8, 16, 32, 64, 200, 1000), smooth),
    Sweep("pattern", "squares per side of the floor", (2, 6, 20, 60, 100), checkered,
          largest_step=lambda squares: SQUARE_SHARE * FLOOR_SIDE / squares),
    Sweep("path length", "max_depth", (2, 3, 4, 6, 8, 12), lambda depth: cornell(int(depth), 0.06)),
)  # fmt: skip
QUICK, QUICK_STRIDE = ("contact distance", "scene offset"), 3


@dataclass
class Opened:
    sweep: Sweep
    value: float
    problem: methods.Problem
    settings: Settings
    reference: figures.Reference | None = None
    reference_row: dict[str, Any] | None = None


def case_names() -> list[str]:
    return sweeps.case_names(SWEEPS)


def quick_case_names() -> list[str]:
    return sweeps.quick_case_names(SWEEPS, QUICK, QUICK_STRIDE)


def method_names(case: str) -> list[str]:
    return list(METHODS)


def open_case(name: str, settings: Settings) -> Opened:
    sweep, value = sweeps.find(SWEEPS, name)
    step = replace(sweep.step(value), name=name)
    return Opened(sweep, value, methods.Problem(step, cases.load(step, RES, **LOAD), {"res": RES, **LOAD}), settings)


def reference_of(opened: Opened) -> figures.Reference:
    """Central differences of this step, or of the case that has the same derivative; made once per process."""
    if opened.reference is None:
        truth = opened.sweep.one_truth
        case = opened.problem.case if truth is None else truth
        motion = opened.problem.motion if truth is None else cases.load(truth, RES, **LOAD)
        difference = CentralDifference(motion, case.limits)
        if opened.sweep.largest_step is not None:
            eps = min(difference.eps, opened.sweep.largest_step(opened.value))
            difference = CentralDifference(motion, case.limits, eps=eps)
        start = time.perf_counter()
        while difference.seeds < 8 or time.perf_counter() - start < REFERENCE_BUDGETS * opened.settings.budget:
            difference.add(2)
        one, two = (half.group_means() for half in difference.halves)
        squared_error = float(np.mean(np.concatenate([one, two]).var(axis=0, ddof=1)) / (len(one) + len(two)))
        opened.reference = figures.Reference(np.stack([one.mean(0), two.mean(0)]), squared_error, (one, two))
        opened.reference_row = {"eps": difference.eps, "spp": difference.spp, "seeds": 2 * difference.seeds}
    return opened.reference


def measure(opened: Opened, method_name: str) -> dict[str, Any]:
    """The row of one method at one step, without circumstances."""
    row, renders = methods.attempt(
        methods.named(method_name), opened.problem, opened.settings.budget, SLOWEST_FIRST_RENDER
    )
    row = {"bench": NAME, "sweep": opened.sweep.name, "value": opened.value, **row}
    if renders is None:
        return row
    reference = reference_of(opened)
    found = {k: v for k, v in figures_of(renders, reference).items() if k != "curve"}
    return {**row, **found, "reference": opened.reference_row}
