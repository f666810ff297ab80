"""The steps of a scene's lights: found once, kept while their pictures are the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.memory import Memory, Slot
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.capabilities import CONE_PARAMETERS
from ..scene.facts import EmitterFacts
from ..scene.patterns import step_families, stepping_textures, texture_values
from .light_step_rows import CORNERS, LightStepRows, light_step_rows, rows_of_light
from .light_steps import LightSteps, films_of
from .pattern_rows import MOST_LINES, too_fine
from .scene_patterns import same_parameters


@dataclass(frozen=True)
class _Known:
    """Rows, and what they were made from, kept alive so that it can be told from something else."""

    values: list[Any]
    rows: LightStepRows | None


#: Of an integrator: the rows last made.
ROWS: Slot[_Known | None] = Slot(lambda: None)

#: Of one render call: the steps, in a list so that none can be told from not asked for.
STEPS: Slot[list[LightSteps | None]] = Slot(list)


def light_steps(job: Job) -> LightSteps | None:
    """The steps of all lights, built once per render call; None without any."""
    if not job.shared[STEPS]:
        job.shared[STEPS].append(_light_steps(job) if job.facts.has_light_steps else None)
    return job.shared[STEPS][0]


def _light_steps(job: Job) -> LightSteps | None:
    chosen = [i for i, facts in enumerate(job.facts.emitters) if facts.steps]
    lights, facts = tuple(job.scene.emitters()[i] for i in chosen), [job.facts.emitters[i] for i in chosen]
    rows = _rows(lights, facts, job.call.memory)
    if rows is None:
        return None
    far = job.facts.extent or 1.0
    with dr.suspend_grad():
        films = dr.detach(films_of(lights, far))
    moving = mi.UInt32([int(bool(f.pose)) for f in facts])
    dr.eval(films, moving)
    return LightSteps(rows, lights, films, moving, any(CONE_PARAMETERS & set(f.pose) for f in facts), far)


def _rows(lights: tuple[mi.Emitter, ...], facts: list[EmitterFacts], memory: Memory) -> LightStepRows | None:
    textures = [stepping_textures([light]) for light in lights]
    values = [*lights, *(f.rim for f in facts)]
    values += [value for found in textures for value in (*found, *(dr.detach(v) for v in texture_values(found)))]
    known = memory[ROWS]
    if known is None or not same_parameters(known.values, values):
        parts = [_rows_of(*of, memory) for of in zip(facts, textures, strict=True)]
        known = _Known(values, light_step_rows(parts))
        dr.eval(known.rows)
        memory[ROWS] = known
    return known.rows


def _rows_of(facts: EmitterFacts, textures: list[mi.Texture], memory: Memory) -> dict:
    families = [family for texture in textures for family in step_families(texture)]
    kept = [family for family in families if not too_fine(family, CORNERS)]
    if len(kept) < len(families):
        message = (f"emitter '{facts.name}' has more than {MOST_LINES} parallel steps in its picture: their part of "
                   "the derivative is missing; use a smaller to_uv, or the mean colour")  # fmt: skip
        warn_once(message, UnsupportedWarning, memory)
    return rows_of_light(kept, facts.plugin == "projector", facts.rim == "hard")
