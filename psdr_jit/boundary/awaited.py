"""What moves, and is waited for: an aim of sensor subpaths that count if they meet it, and else bring nothing.

What is seen across an edge that rests changes where the viewer slides: what moves must be met on the way to the sensor.
Until it is, a share of the directions leads there, directly or by way of mirrors (`sampling/mirror_images.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..edges.kind import Use
from ..paths.bounce import PathLimits
from ..paths.scattering import Aim
from ..plan.job import Job
from ..sampling.relevance import Movers, movers_of
from ..scene.registry import registry_table


@dataclass(frozen=True)
class Awaited:
    """What moves, for subpaths that count if they meet it. Host object."""

    movers: Movers
    moving: mi.UInt32  # by registry index of a shape: 1 if it moves

    @staticmethod
    def of(job: Job, waits: mi.Bool | None) -> Awaited | None:
        """None if no subpath waits, or if no mirror shows what moves: it is then near what sees it, and BSDFs do."""
        movers = None if waits is None else movers_of(job, Use.STEP)
        if movers is None or not movers.in_mirrors:
            return None
        return Awaited(movers, registry_table(job.scene, {s.index for s in job.facts.shapes if s.moves}))

    def met(self, shape: mi.UInt32) -> mi.Bool:
        return dr.gather(mi.UInt32, self.moving, shape, (shape != 0) & (shape < dr.width(self.moving))) != 0

    def aimed(self, limits: PathLimits, x: mi.Point3f, waits: mi.Bool) -> PathLimits:
        """The limits with an aim from `x`, for those that wait."""
        return replace(limits, aim=Aim(self.movers.seen_from(x), waits))
