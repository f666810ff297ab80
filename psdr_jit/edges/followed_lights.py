"""Area lights whose emission is followed along directions: those that touch what they shine on.

In the material form of emission (`interior/flow.py`) a point y of a light stays on its material. Beside the curve where
the light meets a surface, the derivative of the geometry term between y and the surface is not absolutely integrable
(`contact_limits.py`). Emission of such a light is treated as all other light is in the spatial form: the direction ω in
which it was sampled stays,

    f(ω) · L_e(met by ω) / p_sa(ω),

and whatever hides the light, ends it or steps on it is an edge beside which the radiance jumps: of the indirect term,
which counts what these lights emit; the direct term leaves them out.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Slot
from ..core.upload import uploaded
from ..plan.job import Job
from ..scene.shading_normals import is_shaded_smoothly
from .overlaps import box_of
from .scene_table import scene_edges

#: How far boxes of shapes that touch may be apart, relative to their size.
BOX_TOLERANCE = 1e-4


@dataclass(frozen=True)
class FollowedLights:
    """Host object; `member` is detached."""

    names: tuple[str, ...]
    member: mi.Bool  # by registry index of emitters

    def has(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Bool:
        """Is the emission of these followed along directions? Not where there is no emitter."""
        index = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.Bool, self.member, index, active & (index < dr.width(self.member)))


#: Of one render call: the lights, in a tuple once they have been looked for.
FOLLOWED: Slot[tuple[FollowedLights | None] | None] = Slot(lambda: None)


def followed_lights(job: Job) -> FollowedLights | None:
    """Read once per render call; None if there are none, or in another form than the spatial one."""
    if job.form != "spatial" or not job.facts.geometry_moves or job.options.depth_limit < 2:
        return None
    if job.shared[FOLLOWED] is None:
        job.shared[FOLLOWED] = (_found(job),)
    return job.shared[FOLLOWED][0]


def is_followed(job: Job, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Bool:
    """Is the emission of these followed along directions? A literal if it is in no case."""
    lights = followed_lights(job)
    return mi.Bool(False) if lights is None else lights.has(emitter, active)


def _found(job: Job) -> FollowedLights | None:
    if not _boxes_touch(job):
        return None
    with dr.suspend_grad():
        lamps = [lamp for lamp, _ in scene_edges(job).touching.lamps if not is_shaded_smoothly(lamp, job.call.memory)]
    if not lamps:
        return None
    index = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(lamp.emitter()))[0]) for lamp in lamps]
    member = np.zeros(max(index) + 1, bool)
    member[index] = True
    return FollowedLights(tuple(dict.fromkeys(lamp.id() for lamp in lamps)), uploaded(mi.Bool, member))


def _boxes_touch(job: Job) -> bool:
    """May any area light touch another shape? Edges need not be known to say no."""
    shapes, facts = job.scene.shapes(), [s for s in job.facts.shapes if s.index >= 0]
    lights = np.array([s.is_emitter for s in facts], bool)
    if not lights.any():
        return False
    lower, upper = np.stack([box_of(shapes[s.index]) for s in facts], axis=1)
    slack = BOX_TOLERANCE * (np.linalg.norm(upper - lower, axis=1, keepdims=True) + np.abs(upper).max())
    lower, upper = lower - slack, upper + slack
    for k in np.flatnonzero(lights):
        near = np.all((lower <= upper[k]) & (upper >= lower[k]), axis=1)
        if near.sum() > 1:
            return True
    return False
