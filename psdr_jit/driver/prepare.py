"""From a scene to the plan of its derivative: facts, checks, budgets, form.

`prepare` is what every render call goes through; the integrator runs the jobs it returns and nothing else.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.counters import Counters
from ..core.film import require_film
from ..core.memory import Memory, Slot
from ..edges.convexity import lone_convex
from ..edges.followed_lights import followed_lights
from ..errors import OptionError, UnsupportedError, ZeroDerivativeWarning
from ..options import FOLLOWING, MATERIAL, MIXED, SPATIAL, Options, of_vertices, require_runtime, samples_per_pixel
from ..plan.call import Call
from ..plan.decide import decide, make_plan_of
from ..plan.form_choice import forms_to_try, why_film_is_not_tried, why_film_rests
from ..plan.job import Job
from ..plan.light_plan import plan_light
from ..plan.plan import NO_EDGES, SWITCHED_OFF, Geometry, Plan, TermPlan
from ..plan.term import Term
from ..scene.checks import require_supported
from ..scene.facts import SceneFacts, analyse
from ..scene.mesh_tables import CallVariables
from ..scene.tangent_facts import facts_along_tangents
from . import pilot
from .fewer_pixels import on_fewer_pixels
from .noise_log import NoiseLog
from .pilot import Measurement
from .question import Question
from .terms import TERMS
from .warn_about import warn_about

#: Why a term that is needed may be left out by a given plan all the same.
MAY_BE_OUT = (SWITCHED_OFF, NO_EDGES)

#: Why terms have their samples, and pixels theirs.
BY_NOISE = "by measured noise, of terms, pixels and lines, as costly as equal ones"

#: What is known of the noise of each kind of call, and the latest pilot of each kind by its number.
NOISE: Slot[dict[tuple, NoiseLog]] = Slot(dict)
PILOTS: Slot[dict[tuple, dict[int, Measurement]]] = Slot(dict)


@dataclass(frozen=True)
class Prepared:
    """What has to run: the plan, and a job for each of its running terms."""

    plan: Plan
    facts: SceneFacts
    jobs: list[tuple[Term, Job]]
    log: NoiseLog | None  # wants to see the derivative images of forward mode
    plain: Callable[[int], Job]  # the job of what is no term: so many paths per pixel, spread evenly
    moving: list[CallVariables]  # variables in place of what moves, for as long as the call lasts

    def observe(self, seed: object, images: Mapping[str, mi.TensorXf]) -> None:
        """Hand over the images of all terms."""
        if self.log is not None:
            self.log.observe(self.plan.form, seed, {t.name: t.spp for t in self.plan.terms}, images)


def prepare(call: Call) -> Prepared:
    """The plan and its jobs. Raises typed errors before any ray is traced."""
    _require_unfrozen()
    film = call.film
    require_film(film)
    given = _given(call.options)
    budgets = _budgets(call) if given is None else {t.name: t.spp for t in given.terms}
    require_runtime(call.seed, max(budgets.values()) * int(film.crop_size()[0]) * int(film.crop_size()[1]))
    facts = _facts(call)
    require_supported(facts, call.memory)
    warn_about(call, facts)
    question = Question(call, facts, budgets, Memory())
    plan, log = _plan(question) if given is None else (_as_given(given, question), None)
    switched_off = any(term.reason == SWITCHED_OFF for term in plan.terms)
    if not plan.running and facts.anything_enabled and not switched_off:
        reasons = "; ".join(dict.fromkeys(term.reason for term in plan.terms))
        warnings.warn(f"the derivative is 0: {reasons}", ZeroDerivativeWarning, stacklevel=5)
    by_name = {term.name: term for term in TERMS}
    listens = log is not None and question.automatic  # in every call: others would need kernels of their own
    tallies = {t.name: log.heard(plan.form, t.name) if listens else None for t in plan.running}
    jobs = [(by_name[t.name], question.job(plan, t.spp, t, tallies[t.name])) for t in plan.running]
    return Prepared(plan, facts, jobs, log, _plain(question, plan), question.moving)


def _plain(q: Question, plan: Plan) -> Callable[[int], Job]:
    """Jobs of what is no term, for which places on the film rest."""
    resting = replace(plan, form=of_vertices(plan.form))
    return lambda spp: q.job(resting, spp)


def _require_unfrozen() -> None:
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UnsupportedError(
            "derivatives cannot be recorded by dr.freeze: which paths and edges matter is read back in every call; "
            "freeze what is around it, such as the loss or what makes the parameters, and render and differentiate "
            "outside of the frozen function (images alone can be frozen)"
        )


def _spread(plan: Plan, measured: Measurement) -> Plan:
    """The plan with samples where on the film noise was seen, and of lines that brought something."""
    noise = measured.noise[plan.form]
    films = {name: n.film.density for name, n in noise.items() if n.film is not None}
    lines = {name: n.lines for name, n in noise.items()}

    def spread(t: TermPlan) -> TermPlan:
        return replace(t, film=films.get(t.name), lines=lines.get(t.name)) if t.runs else t

    return replace(plan, terms=tuple(spread(t) for t in plan.terms))


def _given(options: Options) -> Plan | None:
    """The plan that was given, if one was; it must speak of the terms that there are."""
    if not options.plan_is_given:
        return None
    plan = Plan.from_json(options.plan)
    known, named = [t.name for t in TERMS], [t.name for t in plan.terms]
    if sorted(known) != sorted(named):
        raise OptionError(
            f"the given plan has the terms {', '.join(named) or '(none)'}, but there are {', '.join(known)}: "
            "make it anew with psdr_jit.make_plan"
        )
    return plan


def _as_given(plan: Plan, q: Question) -> Plan:
    """The plan as it was given, but for terms with a budget of 0. Raises if it leaves out what is needed."""
    geometry = _geometry(q, plan.prunes)
    fresh = decide(TERMS, q.facts_in(plan.form), q.call.options, geometry, dict.fromkeys(q.budgets, 1))
    needed = {t.name for t in fresh if t.runs}
    missing = needed - {t.name for t in plan.terms if t.runs or t.reason in MAY_BE_OUT}
    missing |= _with_edges(plan, q) & needed
    film_rests = why_film_rests(q.call, q.facts, plan.light)
    if plan.form in FOLLOWING and film_rests:
        raise OptionError(
            f"the given plan has the form '{plan.form}', but {film_rests}; make it anew with psdr_jit.make_plan"
        )
    if missing:
        raise OptionError(
            f"the given plan leaves out {', '.join(sorted(missing))}, which this derivative needs: it was made for "
            "other parameters or another scene; make it anew with psdr_jit.make_plan"
        )
    budgets = {t.name: q.call.options.budget(t.budget) for t in TERMS}
    off = {"runs": False, "reason": SWITCHED_OFF, "spp": 0, "streams": (), "segments": 0, "film": None, "lines": None}
    return replace(plan, terms=tuple(replace(t, **off) if budgets[t.name] == 0 else t for t in plan.terms))


def _with_edges(plan: Plan, q: Question) -> set[str]:
    """Terms that were left out for want of edges, and have some in this scene."""
    out = {t.name for t in plan.terms if t.reason == NO_EDGES}
    with dr.suspend_grad():
        weights = {t.name: t.edges.weights(q.job(plan, 1)) for t in TERMS if t.name in out}
    return {name for name, found in weights.items() if any(dr.any(w > 0)[0] for w in found)}


def _facts(call: Call) -> SceneFacts:
    if call.options.direction == "any":
        return analyse(call.scene, call.sensor, memory=call.memory)
    if call.mode == "backward":
        raise OptionError('direction="known" is for forward mode: backward mode answers for every direction at once; '
                          'use direction="any"')  # fmt: skip
    return facts_along_tangents(call.scene, call.sensor, call.memory)


def _budgets(call: Call) -> dict[str, int]:
    """Paths per pixel by term, as asked for."""
    sampler = call.sensor.sampler().sample_count()
    budgets = {t.name: samples_per_pixel(call.options.budget(t.budget), call.spp, sampler) for t in TERMS}
    if not any(budgets.values()):
        names = ", ".join(dict.fromkeys(term.budget for term in TERMS))
        raise OptionError(f"every term is switched off ({names} are 0): give one of them samples per pixel")
    return budgets


def _plan(q: Question) -> tuple[Plan, NoiseLog | None]:
    """Terms first, then form and budgets, for which a pilot may have to be run (`pilot.py`)."""
    call, budgets = q.call, q.budgets
    geometry = _geometry(q, call.options.plan == "lean")
    light = plan_light(call.scene, q.facts, call.options, call.memory)
    film_rests = why_film_rests(call, q.facts, light) or why_film_is_not_tried(call)
    forms, reason = forms_to_try(call.scene, q.facts, call.options, geometry, light, film_rests)

    def made(spp: Mapping[str, int], form: tuple[str, str], why: str) -> Plan:
        terms = decide(TERMS, q.facts_in(form[0]), call.options, geometry, spp)
        return make_plan_of(terms, call.options, form, why, light)

    plan = made(budgets, (forms[0], reason), "equal")
    over_film = {t.name for t in TERMS if t.over_film and q.facts.geometry_moves}  # the pilot's probe is a motion
    automatic = q.automatic and (len(plan.running) > 1 or any(t.name in over_film for t in plan.running))
    if not plan.running or (len(forms) == 1 and not automatic):
        return plan, None
    log = call.memory[NOISE].setdefault((call.options, *_kind(q, forms), *budgets.values()), NoiseLog())
    if log.needs_pilot:
        # Terms that are switched off here as well: integrators of one term each must agree on the form.
        ones = dict.fromkeys(budgets, 1)
        names = {term.name for form in forms for term in made(ones, (form, ""), "").running}
        log.pilot(_pilot(q, plan, forms, names, log.epoch))
    if log.current is not None and log.due:
        log.learn()
        form = _best_form(log.measured, max(budgets.values()), (forms[0], reason))
        spp, why = budgets, "equal"
        if automatic:
            running = {term.name for term in made(budgets, form, "").running}
            spp, why = log.current.allocate(form[0], budgets, running), BY_NOISE
        log.share = (spp, form, why)
    log.calls += 1
    # Which terms run is decided anew in every call: the scene may have changed since.
    if log.share is None:
        return plan, log
    plan = made(*log.share)
    return _spread(plan, log.current) if automatic else plan, log


def _geometry(q: Question, prunes: bool) -> Geometry:
    """What the terms want to know about the shapes' vertices, where anything is left out by it."""
    call = q.call
    if not q.facts.geometry_moves:
        return Geometry()
    alone = lone_convex(call.scene, call.sensor, q.facts, call.memory) if prunes else ""
    if of_vertices(call.options.form) in (MATERIAL, MIXED):
        return Geometry(alone)
    lights = followed_lights(q.job(Plan(SPATIAL, "", "", (), prunes), 1))
    return Geometry(alone, "" if lights is None else lights.names[0])


def _kind(q: Question, forms: tuple[str, ...]) -> tuple:
    """What calls of one kind have in common, whatever their budgets."""
    o, sensor = q.call.options, q.call.sensor
    options = (o.max_depth, o.rr_depth, o.hide_emitters, o.plan, o.direction, o.guide, o.light_paths)
    return (q.facts.enabled, q.facts.sensor.name, tuple(sensor.film().crop_size()), options, forms)


def _pilot(q: Question, plan: Plan, forms: tuple[str, ...], names: set[str], epoch: int) -> Measurement:
    """The pilot of this epoch; run unless an integrator with the same memory has done so."""
    found = q.call.memory[PILOTS].setdefault(_kind(q, forms), {})
    if epoch not in found:
        call = on_fewer_pixels(q.call)
        q = q if call is q.call else replace(q, call=call, shared=Memory())

        def job_of(form: str, seed: int, spp: int) -> Job:
            call = replace(q.call, seed=seed, counters=Counters())
            formed = replace(plan, form=form)
            return Job(call, q.facts_in(form), formed, q.probe_of(formed), q.shared, spp)

        found.clear()
        sky = q.call.scene.environment() is not None
        found[epoch] = pilot.measure(job_of, forms, names, sky, q.call.options.guide)
    return found[epoch]


def _best_form(measured: Measurement, spp: int, single: tuple[str, str]) -> tuple[str, str]:
    """The form with less variance × cost when all terms share the budget, and why; `single`: if there is one only.

    By the pilot alone, so that integrators of single terms, whose images are added up, agree.
    """
    work, measured = {}, measured.alike()
    for form, noise in measured.noise.items():
        even = dict.fromkeys(noise, spp)
        work[form] = measured.efficiency(form, measured.allocate(form, even, even))
    best, worst = min(work, key=work.get), max(work, key=work.get)
    if len(work) < 2 or not work[best] > 0:
        return single
    return best, f"{work[worst] / work[best]:.2g} times less variance x cost than {worst}, by a pilot"
