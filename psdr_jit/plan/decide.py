"""Which terms run, and why: asked of each term in turn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ..options import Options
from ..scene.facts import SceneFacts
from .light_plan import LightPlan
from .plan import SWITCHED_OFF, Geometry, Plan, TermPlan
from .reasons import NO_LIGHT, nothing_to_compute
from .term import Term, Verdict

#: Segments of a path that count when its cost is estimated: deeper ones are rare or dim.
TYPICAL_DEPTH = 5


def decide(
    terms: Iterable[Term], facts: SceneFacts, options: Options, geometry: Geometry, spp: Mapping[str, int]
) -> tuple[TermPlan, ...]:
    """What each term does with `spp` paths per pixel (by name; 0: switched off)."""
    return tuple(_decide(term, _verdict(term, facts, options, geometry), options, spp[term.name]) for term in terms)


def _verdict(term: Term, facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """In or out, and why."""
    if options.plan == "full":
        return True, "the planner is off"
    nothing = nothing_to_compute(facts, options)
    if not facts.emitters and not term.covers:
        nothing = nothing or NO_LIGHT
    return term.needed(facts, options, geometry) if nothing is None else (False, nothing)


def _decide(term: Term, verdict: Verdict, options: Options, spp: int) -> TermPlan:
    runs, reason = verdict
    if spp == 0 and runs:
        runs, reason = False, SWITCHED_OFF
    count = spp if runs else 0
    streams = tuple(stream.name for stream in term.streams) if runs else ()
    return TermPlan(term.name, runs, reason, count, streams, count * min(options.depth_limit, TYPICAL_DEPTH))


def make_plan_of(
    terms: tuple[TermPlan, ...],
    options: Options,
    form: tuple[str, str],
    budget_reason: str,
    light: LightPlan | None = None,
) -> Plan:
    """The plan that consists of `terms`; `form`: `(form, reason)`."""
    return Plan(*form, budget_reason, terms, options.plan != "full", light)
