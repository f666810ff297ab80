"""From a scene to the plan of its derivative: facts, checks, budgets, form. `make_plan` is the public way to ask.

`prepare` is what every render call goes through; the integrator runs the jobs it returns and nothing else.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import pilot
from . import plan as plans
from .boundary.edges import scene_edges
from .convexity import lone_convex
from .errors import OptionError, ZeroDerivativeWarning
from .film import require_film
from .forms import forms_to_try
from .integrators import build, integrator_spec
from .job import Job
from .noise_log import NoiseLog
from .options import Options, require_runtime, samples_per_pixel
from .params import also_enabled
from .pilot import Measurement
from .plan import EdgeCount, Geometry, Plan
from .rejected import Rejected
from .scene_analysis import SceneFacts, analyse
from .scene_checks import require_supported, warn_about_missing_terms
from .scene_guard import require_derivatives
from .scene_io import find_sensor
from .stale_normals import warn_about_stale_normals
from .terms import TERMS, Term
from .threads import one_at_a_time
from .trial import trial_of
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
    grazing: Rejected
    seed: int | mi.UInt32
    spp: int  # 0: left to the options and the sampler
    mode: str = "forward"  # or "backward"


@dataclass(frozen=True)
class Prepared:
    """What has to run: the plan, and a job for each of its running terms."""

    plan: Plan
    jobs: list[tuple[Term, Job]]
    log: NoiseLog | None  # wants to see the derivative images of forward mode

    def observe(self, seed: object, images: Mapping[str, mi.TensorXf]) -> None:
        """Hand over the images of all terms."""
        if self.log is not None:
            self.log.observe(self.plan.form, seed, {t.name: t.spp for t in self.plan.terms}, images)


def prepare(call: Call) -> Prepared:
    """The plan and its jobs. Raises typed errors before any ray is traced."""
    film = call.sensor.film()
    require_film(film)
    budgets = _budgets(call)
    require_runtime(call.seed, max(budgets.values()) * int(film.crop_size()[0]) * int(film.crop_size()[1]))
    facts = _facts(call)
    require_supported(facts, call.cache)
    if call.mode == "backward":
        warn_about_stale_normals(call.scene, facts, call.cache)
    warn_about_missing_terms(facts, [term.name for term in TERMS], call.options.depth_limit, call.cache)
    shared: dict = {}
    plan, log = _plan(call, facts, budgets, shared)
    switched_off = any(term.reason == plans.SWITCHED_OFF for term in plan.terms)
    if not plan.running and facts.anything_enabled and not switched_off:
        reasons = "; ".join(dict.fromkeys(term.reason for term in plan.terms))
        warnings.warn(f"the derivative is 0: {reasons}", ZeroDerivativeWarning, stacklevel=4)
    jobs = [
        (term, Job(
            call.integrator, call.scene, call.sensor, facts, call.options, plan, call.cache, shared, call.rejected,
            call.grazing, call.seed, plan.term(term.name).spp,
        ))
        for term in TERMS if plan.term(term.name).runs
    ]  # fmt: skip
    return Prepared(plan, jobs, log)


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


def _plan(call: Call, facts: SceneFacts, budgets: Mapping[str, int], shared: dict) -> tuple[Plan, NoiseLog | None]:
    """Terms first, then form and budgets, for which a pilot may have to be run (`pilot.py`)."""
    geometry = Geometry()
    if facts.geometry_moves and call.options.plan == "lean":
        geometry = Geometry(lone_convex(call.scene, call.sensor, facts, call.cache))
    forms, reason = forms_to_try(call.scene, facts, call.options)

    def made(spp: Mapping[str, int], form: tuple[str, str], why: str) -> Plan:
        return plans.make(facts, call.options, geometry, spp, form, why)

    plan = made(budgets, (forms[0], reason), "equal")
    automatic = len(plan.running) > 1 and call.options.plan == "lean" and not call.options.budgets_set
    if not plan.running or (len(forms) == 1 and not automatic):
        return plan, None
    log = call.cache.setdefault(("noise", call.options, *_kind(call, facts, forms), *budgets.values()), NoiseLog())
    if log.needs_pilot and not dr.flag(dr.JitFlag.FreezingScope):  # which records, but must not read back
        # Terms that are switched off here as well: integrators of one term each must agree on the form.
        names = [term.name for term in made(dict.fromkeys(budgets, 1), (forms[0], ""), "").running]
        log.pilot(_pilot(call, facts, plan, forms, names, log.epoch, shared))
    if log.current is not None and log.due:
        log.learn()
        form = _best_form(log.measured, max(budgets.values()), (forms[0], reason))
        spp, why = budgets, "equal"
        if automatic:
            running = {term.name for term in plan.running}
            spp, why = log.current.allocate(form[0], budgets, running), "by measured noise, as costly as equal ones"
        log.plan = made(spp, form, why)
    log.calls += 1
    return log.plan or plan, log


def _kind(call: Call, facts: SceneFacts, forms: tuple[str, ...]) -> tuple:
    """What calls of one kind have in common, whatever their budgets."""
    o = call.options
    options = (o.max_depth, o.rr_depth, o.hide_emitters, o.plan, o.direction)
    return (facts.enabled, facts.sensor.name, tuple(call.sensor.film().crop_size()), options, forms)


def _pilot(
    call: Call, facts: SceneFacts, plan: Plan, forms: tuple[str, ...], names: list[str], epoch: int, shared: dict
) -> Measurement:
    """The pilot of this epoch; run unless an integrator with the same cache has done so."""
    found = call.cache.setdefault(("pilot", *_kind(call, facts, forms)), {})
    if epoch not in found:
        trial = trial_of(call.scene, facts)

        def job_of(form: str, seed: int, spp: int) -> Job:
            return Job(
                call.integrator, call.scene, call.sensor, facts, call.options, replace(plan, form=form), call.cache,
                shared, Rejected(), Rejected(), seed, spp, trial,
            )  # fmt: skip

        found.clear()
        found[epoch] = pilot.measure(job_of, forms, names, call.scene.environment() is not None)
    return found[epoch]


def _best_form(measured: Measurement, spp: int, single: tuple[str, str]) -> tuple[str, str]:
    """The form with less variance × cost when all terms share the budget, and why; `single`: if there is one only.

    By the pilot alone, so that integrators of single terms, whose images are added up, agree.
    """
    work = {}
    for form, noise in measured.noise.items():
        even = dict.fromkeys(noise, spp)
        work[form] = measured.efficiency(form, measured.allocate(form, even, even))
    best, worst = min(work, key=work.get), max(work, key=work.get)
    if len(work) < 2 or not work[best] > 0:
        return single
    return best, f"{work[worst] / work[best]:.2g} times less variance x cost than {worst}, by a pilot"


@one_at_a_time
def make_plan(scene: Any, params: Any = None, sensor: Any = 0, integrator: Any = None, spp: int = 0) -> Plan:
    """What differentiating `scene` by the parameters with gradients enabled would do.

    Traces rays only where form or budgets depend on noise, for a pilot of a few samples per pixel. `params`: name or
    names of parameters that count as enabled as well, or the scene's `mi.SceneParameters` (nothing more). `sensor`: its
    index, or the sensor. `integrator`: a `psdr_path`, a dict of its properties, or None. `spp`: as in `mi.render`, 0:
    what the integrator and the sampler say. The sizes of the edge sets are counted. Raises what rendering would raise:
    `OptionError`, `SceneError`, `UnsupportedError`.
    """
    require_derivatives()
    view = find_sensor(scene, sensor)
    if not hasattr(integrator, "call"):
        integrator = build(integrator_spec(scene, integrator))
    if not hasattr(integrator, "call"):
        raise OptionError(f"{type(integrator).__name__} has no plan: use psdr_path")
    names = [] if params is None or isinstance(params, mi.SceneParameters) else params
    names = [names] if isinstance(names, str) else list(names)
    with also_enabled(scene, names):
        prepared = prepare(integrator.call(scene, view, 0, spp))
        counts = {term.name: _count(term, job) for term, job in prepared.jobs if term.weights is not None}
    return plans.with_edges(prepared.plan, counts)


def _count(term: Term, job: Job) -> EdgeCount:
    table = scene_edges(job)
    total = table.segment_count + table.buried + (dr.width(table.curves.rows.shape) if table.has_curves else 0)
    with dr.suspend_grad():
        weights = term.weights(job)
    sampled = 0 if weights is None else int(np.count_nonzero(np.array(weights)))
    return EdgeCount(sampled, total, LEFT_OUT[term.name], table.buried)
