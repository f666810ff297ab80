"""The methods that are compared, one adapter each. All get the same film, sensor, path lengths and parameter.

What a method cannot do it says by raising: the row then has the message instead of figures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from benchmarks.baselines import projective, reparam
from benchmarks.cases import Case
from benchmarks.measure import (
    FIRST_SEED,
    MAX_RENDERS,
    MIN_RENDERS,
    CannotRenderError,
    Renders,
    collect,
    finite,
    timed,
)
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import FD_SEED, OWN, CentralDifference
from psdr_jit.derivative.perturbation import Perturbation
from psdr_jit.errors import PsdrError
from psdr_jit.scene import io as scene_io

SPP = 16
#: How it is said that something cannot be done; Mitsuba's integrators raise plain Exceptions.
FAILURES = Exception
OWN_FAILURES = (CannotRenderError, PsdrError)
RENDERS_OF_PATIENCE = 4.0  # budgets beyond the first render that another process gets
FD_METHOD_SEED = FD_SEED + (1 << 20)  # apart from the seeds of the checks


@dataclass(frozen=True)
class Problem:
    """A case at a resolution, loaded."""

    case: Case
    motion: Perturbation
    load: dict[str, Any]  # overrides of the scene file's defaults, `res` included


@dataclass(frozen=True)
class Method:
    """`family`: `ours`, `projective` (the peer that ratios are taken against), or `other`."""

    name: str
    family: str
    collect: Callable[[Problem, float, float], Renders]  # budget [s], limit of a first render [s]
    spp: int = SPP
    settings: dict[str, Any] = field(default_factory=dict)


def one_by_one(open_case: Callable[[Problem], Callable[[int], tuple[np.ndarray, float]]]) -> Callable:
    """`Method.collect` of a method that renders in this process: seed -> (image, seconds)."""
    return lambda problem, budget, max_first: collect(open_case(problem), budget, max_first)


def named(name: str) -> Method:
    return next(method for method in METHODS if method.name == name)


def attempt(method: Method, problem: Problem, budget: float, max_first: float) -> tuple[dict[str, Any], Renders | None]:
    """The beginning of a row, and renders for `budget` seconds; None, and the reason in the row, if it cannot."""
    case = problem.case
    row = {
        "case": case.name, "method": method.name, "family": method.family,
        "settings": {**problem.load, **case.limits, **case.load, **method.settings, "spp": method.spp,
                     "parameter": case.param, "motion": problem.motion.label, "budget": budget},
    }  # fmt: skip
    try:
        renders = method.collect(problem, budget, max_first)
    except OWN_FAILURES if method.family == "ours" else FAILURES as error:
        return {**row, "status": "cannot", "error": last_line(error)}, None
    return {**row, "status": "ok"}, renders


def last_line(error: BaseException) -> str:
    """Dr.Jit wraps an exception in others; the first one of the chain has the reason."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def renders_of(integrator: Any, motion: Perturbation, spp: int) -> Callable[[int], tuple[np.ndarray, float]]:
    """Forward-mode renders; `params.update()`, in which Mitsuba rebuilds its acceleration structure, is not timed."""
    sensor = motion.scene.sensors()[0]

    def render(seed: int) -> tuple[np.ndarray, float]:
        motion.attach()
        image, seconds = timed(
            lambda: integrator.render_forward(motion.scene, motion.params, sensor=sensor, seed=seed, spp=spp)
        )
        return integrator_specs.to_image(dr.detach(image)), seconds

    return render


def mitsuba_integrator(plugin: str, tuning: dict[str, Any] | None = None, **options: Any) -> Callable:
    """Any integrator by plugin name. A flat mesh with seams is welded for the projective ones: they take seams for
    borders."""

    @one_by_one
    def open_case(problem: Problem) -> Callable:
        spec = {"type": plugin, **problem.case.limits, **options}
        if plugin == "direct_projective":
            if problem.case.depth != 2:
                raise CannotRenderError(f"direct light only, the case has max_depth {problem.case.depth}")
            spec = {k: v for k, v in spec.items() if k not in ("max_depth", "rr_depth")}
        motion = problem.motion
        if "projective" in plugin and projective.has_seams(motion):
            motion = projective.welded(motion, problem.case)
        return renders_of(projective.integrator(spec, tuning or {}), motion, SPP)

    return open_case


def finite_differences(problem: Problem, budget: float, max_first: float) -> Renders:
    """Central differences of `path` with common random numbers, by the sampler that the scene has, as users take them.

    Setting the scene is part of the time.
    """
    difference = CentralDifference(problem.motion, problem.case.limits, sampler=OWN)

    def render(seed: int) -> tuple[np.ndarray, float]:
        (image,), seconds = timed(lambda: difference.differences([FD_METHOD_SEED + seed]))
        return image, seconds

    return replace(collect(render, budget, max_first), settings={"eps": difference.eps, "fd_spp": difference.spp})


@one_by_one
def edge_sampling(problem: Problem) -> Callable:
    from benchmarks.baselines.edge_sampling import EdgeSampling

    return renders_of(EdgeSampling(**problem.case.limits), problem.motion, SPP)


def prb_reparam(problem: Problem, budget: float, max_first: float) -> Renders:
    """The last Mitsuba that had it, in an environment and a process of its own; reads the scene's file."""
    if problem.case.mesh is not None:
        raise CannotRenderError("reads scenes from files only")
    request = reparam.Request(
        scene=scene_io.shipped_scene(f"{problem.case.scene}.xml"), motion=problem.motion,
        integrator=problem.case.limits, spp=SPP, load={**problem.load, **problem.case.load}, first_seed=FIRST_SEED,
        min_renders=MIN_RENDERS, max_renders=MAX_RENDERS, budget_seconds=budget,
        timeout_seconds=max_first + RENDERS_OF_PATIENCE * budget,
    )  # fmt: skip
    found = reparam.render(request)
    renders = finite(found.images.astype(np.float64), found.seconds, found.warm_up_seconds)
    return replace(renders, settings={"versions_of_method": found.versions})


OURS = Method("psdr_path", "ours", mitsuba_integrator("psdr_path"))
METHODS = (
    OURS,
    Method("psdr_bdpt", "other", mitsuba_integrator("psdr_bdpt")),
    Method("prb", "other", mitsuba_integrator("prb")),
    Method("prb_projective, no guiding", "projective", mitsuba_integrator("prb_projective", guiding="none")),
    Method("prb_projective, small octree", "projective",
           mitsuba_integrator("prb_projective", tuning=projective.SMALL_OCTREE, guiding="octree"),
           settings=projective.SMALL_OCTREE),
    Method("prb_projective, default octree", "projective", mitsuba_integrator("prb_projective", guiding="octree")),
    Method("direct_projective, small octree", "other",
           mitsuba_integrator("direct_projective", tuning=projective.SMALL_OCTREE, guiding="octree"),
           settings=projective.SMALL_OCTREE),
    Method("finite differences", "other", finite_differences, settings={"samples": "fd_spp on either side"}),
    Method("edge sampling", "other", edge_sampling),
    Method("prb_reparam", "other", prb_reparam),
)  # fmt: skip
