"""Which step of a light, and where along it: in proportion to what it parts."""

from __future__ import annotations

import mitsuba as mi

from ..edges.light_steps import LightSteps
from ..edges.scene_light_steps import light_steps
from ..plan.job import Job
from .rows import ROW_SAMPLER, SampledRows, row_state


class SampledSteps(SampledRows):
    """The steps of lights, and how their rows are drawn."""

    table: LightSteps


def sampled_light_steps(job: Job) -> SampledSteps | None:
    """The steps of all lights, whoever moves: a step that rests slides over what moves. None without any."""
    table = light_steps(job)
    state = None if table is None else row_state(job, "light steps", lambda: light_step_weights(job))
    return None if state is None else SampledSteps(table, job.call.memory[ROW_SAMPLER], state)


def light_step_weights(job: Job) -> list[mi.Float]:
    """The relative weight of each step, in a list of one; of none without any."""
    table = light_steps(job)
    return [] if table is None else [table.weights()]
