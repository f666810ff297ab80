"""Where directions from the smooth vertices of a chain are aimed: at lights as mirrors show them, and at what moves.

Light that reaches a surface by way of a mirror is found by paths alone that happen to leave in a direction that leads
back to it; what moves, and parts chains, is often as small. Directions are drawn once for a line (`chain_fixed`), so
that a part of them may lead where it is worth it. Lights that are seen without a mirror need no aim: every vertex sees
a point of light anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.cones import Cones
from ..edges.kind import Use
from ..plan.job import Job
from ..sampling.mirror_images import SeenBalls, lamp_balls, with_images
from ..sampling.relevance import Movers, movers_of

#: Widest cone around what moves that is aimed at, 1 − cos of its half angle: next to it, all directions lead there.
WIDEST = 0.5


@dataclass(frozen=True)
class ChainAims:
    """Host object."""

    lights: SeenBalls | None
    movers: Movers | None

    @staticmethod
    def of(job: Job) -> ChainAims | None:
        """None if there is nothing to aim at."""
        lamps = lamp_balls(job)
        images = with_images(job, lamps)[len(lamps) :]
        movers = movers_of(job, Use.STEP)
        if not images and movers is None:
            return None
        return ChainAims(SeenBalls.of(images) if images else None, movers)

    def seen_from(self, x: mi.Point3f) -> Cones:
        """Half of the directions lead to lights, half to what moves; all to one where there is nothing of the other."""
        groups = [self.lights.seen_from(x)] if self.lights is not None else []
        if self.movers is not None:
            found = self.movers.seen_from(x).cones
            groups.append(Cones(found, tuple(dr.select(c.open < WIDEST, c.open, 0) for c in found)))
        return Cones.of_groups(groups)
