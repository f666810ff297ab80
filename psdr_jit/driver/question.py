"""A call while its plan is being made: what jobs its terms would get, whatever the plan turns out to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from ..core.line_guide import LineTally
from ..core.memory import Memory, Slot
from ..core.streams import other_seed
from ..options import FOLLOWING
from ..plan.call import Call
from ..plan.film_flow import FilmFlow, FilmMotion
from ..plan.job import Job, in_motion, surfaces_of_call
from ..plan.motion import Motion, SceneMotion
from ..plan.plan import Plan, TermPlan
from ..plan.probe_motion import probe_motion
from ..scene.facts import SceneFacts
from ..scene.mesh_tables import CallVariables
from ..scene.registry import registry_table

#: Of one render call: the motion of everything that can move, once it has been asked for.
PROBE: Slot[Motion | None] = Slot(lambda: None)
#: Of one render call: where places on its film go with the scene's motion, and with the probe's.
FLOW: Slot[FilmFlow | None] = Slot(lambda: None)
PROBE_FLOW: Slot[FilmFlow | None] = Slot(lambda: None)
#: Of one render call: the facts of jobs whose places on the film move.
FOLLOWED: Slot[SceneFacts | None] = Slot(lambda: None)


@dataclass(frozen=True)
class Question:
    """A call, the facts it is about, and what its terms will share."""

    call: Call
    facts: SceneFacts
    budgets: Mapping[str, int]  # paths per pixel by term, as asked for
    shared: Memory

    @property
    def automatic(self) -> bool:
        """May budgets follow the measured noise?"""
        return self.call.options.plan == "lean" and not self.call.options.budgets_set

    def job(self, plan: Plan, spp: int, term: TermPlan | None = None, tally: LineTally | None = None) -> Job:
        """The job of a term that gets `spp` paths per pixel, spread as `term` of the plan wishes. `tally`: listens."""
        surfaces = surfaces_of_call(self.call, self.facts, self.shared)
        film, lines = (None, None) if term is None else (term.film, term.lines)
        motion = own = SceneMotion(self.call.sensor, surfaces)
        if plan.form in FOLLOWING:
            motion = FilmMotion(own, self.shared.once(FLOW, lambda: self._flow_of(own)))
        # What a guide has learned from must be independent of what it draws, also if a seed comes back.
        call = self.call if lines is None else replace(self.call, seed=other_seed(self.call.seed, lines.key))
        probe = self.probe_of(plan) if tally is not None and call.mode == "backward" else None
        return Job(call, self.facts_in(plan.form), plan, motion, self.shared, spp, film, lines, tally, probe)

    def facts_in(self, form: str) -> SceneFacts:
        """What a job of this form is told of the scene."""
        if form not in FOLLOWING:
            return self.facts
        return self.shared.once(FOLLOWED, lambda: replace(self.facts, places_move=True))

    def _flow_of(self, motion: Motion) -> FilmFlow:
        moving = None
        if not self.facts.camera_moves:
            moving = registry_table(self.call.scene, {s.index for s in self.facts.shapes if s.moves})
        return FilmFlow.of(self.call.scene, self.call.sensor, self.call.film, motion, moving)

    def probe_of(self, plan: Plan) -> Motion:
        """The motion of everything that can move, as the plan's form has it: seen from places that follow, or rest."""
        if plan.form not in FOLLOWING:
            return self.probe
        return FilmMotion(self.probe, self.shared.once(PROBE_FLOW, self._probe_flow))

    def _probe_flow(self) -> FilmFlow:
        """With its tangents, which are the same throughout a call."""
        flow = self._flow_of(self.probe)
        flow.take_tangents()
        return flow

    @property
    def moving(self) -> list[CallVariables]:
        """Variables in place of what moves, those first that others depend on."""
        flow = self.shared[FLOW]
        return in_motion(self.shared) + ([] if flow is None else [flow])

    @property
    def probe(self) -> Motion:
        """The motion of everything that can move, found once per render call."""
        if self.shared[PROBE] is None:
            surfaces = surfaces_of_call(self.call, self.facts, self.shared)
            self.shared[PROBE] = probe_motion(self.call.scene, self.facts, surfaces)
        return self.shared[PROBE]
