"""From a scene to the plan of its derivative: facts, checks, budgets, form. `make_plan` is the public way to ask.

`prepare` is what every render call goes through; the integrator runs the jobs it returns and nothing else.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import plan as plans
from .boundary.edges import scene_edges
from .convexity import lone_convex
from .errors import OptionError, ZeroDerivativeWarning
from .film import require_film
from .integrators import build, integrator_spec
from .job import Job
from .options import Options, require_runtime, samples_per_pixel
from .params import also_enabled
from .plan import EdgeCount, Geometry, Plan
from .rejected import Rejected
from .scene_analysis import SceneFacts, analyse
from .scene_checks import require_supported, warn_about_missing_terms
from .scene_io import find_sensor
from .terms import TERMS, Term
from .velocities import facts_along_tangents

#: Why edges are left out of a term's distribution.
LEFT_OUT = {
    "primary": "the others rest, are coplanar, turn away or leave the film",
    "direct": "no light sees the others as an outline, or they are coplanar",
    "indirect": "the others are coplanar, or lie inside of closed surfaces",
}


@dataclass(frozen=True)
class Call:
    """One call of an integrator: who renders what. `cache` outlives it."""

    integrator: mi.CppADIntegrator
    scene: mi.Scene
    sensor: mi.Sensor
    options: Options
    cache: dict
    rejected: Rejected
    seed: int | mi.UInt32
    spp: int  # 0: left to the options and the sampler
    mode: str = "forward"  # or "backward"


def prepare(call: Call) -> tuple[Plan, list[tuple[Term, Job]]]:
    """What has to run: the plan, and a job for each of its running terms. Raises typed errors before any ray."""
    film = call.sensor.film()
    require_film(film)
    budgets = _budgets(call)
    require_runtime(call.seed, max(budgets.values()) * int(film.crop_size()[0]) * int(film.crop_size()[1]))
    facts = _facts(call)
    require_supported(facts)
    warn_about_missing_terms(facts, [term.name for term in TERMS], call.options.depth_limit, call.cache)
    plan = _plan(call, facts, budgets)
    if not plan.running and facts.anything_enabled:
        reasons = "; ".join(dict.fromkeys(term.reason for term in plan.terms))
        warnings.warn(f"the derivative is 0: {reasons}", ZeroDerivativeWarning, stacklevel=4)
    shared: dict = {}
    jobs = [
        (term, Job(
            call.integrator, call.scene, call.sensor, facts, call.options, plan, call.cache, shared, call.rejected,
            call.seed, plan.term(term.name).spp,
        ))
        for term in TERMS if plan.term(term.name).runs
    ]  # fmt: skip
    return plan, jobs


def _facts(call: Call) -> SceneFacts:
    if call.options.direction == "any":
        return analyse(call.scene, call.sensor)
    if call.mode == "backward":
        raise OptionError('direction="known" is for forward mode: backward mode answers for every direction at once; '
                          'use direction="any"')  # fmt: skip
    return facts_along_tangents(call.scene, call.sensor)


def _budgets(call: Call) -> dict[str, int]:
    """Paths per pixel by term, as asked for."""
    sampler = call.sensor.sampler().sample_count()
    budgets = {t.name: samples_per_pixel(call.options.budget(t.budget), call.spp, sampler) for t in TERMS}
    if not any(budgets.values()):
        names = ", ".join(dict.fromkeys(term.budget for term in TERMS))
        raise OptionError(f"every term is switched off ({names} are 0): give one of them samples per pixel")
    return budgets


def _plan(call: Call, facts: SceneFacts, budgets: Mapping[str, int]) -> Plan:
    geometry = Geometry()
    if facts.geometry_moves and call.options.plan == "lean":
        geometry = Geometry(lone_convex(call.scene, call.sensor, facts, call.cache))
    form = (call.options.form, "as asked for")
    if call.options.form == "auto":
        form = ("spatial", "the default")
    return plans.make(facts, call.options, geometry, budgets, form, "equal")


def make_plan(scene: Any, params: Any = None, sensor: Any = 0, integrator: Any = None, spp: int = 0) -> Plan:
    """What differentiating `scene` by the parameters with gradients enabled would do, before a ray is traced.

    `params`: names of parameters that count as enabled as well, or the scene's `mi.SceneParameters` (nothing more).
    `sensor`: its index, or the sensor. `integrator`: a `psdr_path`, a dict of its properties, or None. `spp`: as in
    `mi.render`, 0 for what the integrator and the sampler say. The sizes of the edge sets are counted. Raises what
    rendering would raise: `OptionError`, `SceneError`, `UnsupportedError`.
    """
    view = find_sensor(scene, sensor)
    if not hasattr(integrator, "call"):
        integrator = build(integrator_spec(scene, integrator))
    if not hasattr(integrator, "call"):
        raise OptionError(f"{type(integrator).__name__} has no plan: use psdr_path")
    names = [] if params is None or isinstance(params, mi.SceneParameters) else list(params)
    with also_enabled(scene, names):
        plan, jobs = prepare(integrator.call(scene, view, 0, spp))
        counts = {term.name: _count(term, job) for term, job in jobs if term.weights is not None}
    return plans.with_edges(plan, counts)


def _count(term: Term, job: Job) -> EdgeCount:
    table = scene_edges(job)
    total = table.segment_count + (dr.width(table.curves.rows.shape) if table.has_curves else 0)
    with dr.suspend_grad():
        weights = term.weights(job)
    sampled = 0 if weights is None else int(np.count_nonzero(np.array(weights)))
    return EdgeCount(sampled, total, LEFT_OUT[term.name])
