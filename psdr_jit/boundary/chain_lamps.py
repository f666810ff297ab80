"""Lamps that two neighbouring chains may pass, one on each side: what is small and bright hides between them.

As the one chain turns into the other, the point of a line of sight that is nearest to the middle c of a lamp moves
almost evenly, from e_a to e_b (both relative to c). Where it comes as near as the lamp is large, the lamp is probably
met in between. A wrong guess costs the search a comparison (`chain_search`), no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..core.varying import varying
from ..plan.job import Job
from ..sampling.mirror_images import lamp_balls

#: How near a line of sight must come, in radii of the ball around a lamp, to be thought to meet it.
NEAR = 1.5


@dataclass(frozen=True)
class ChainLamps:
    """The balls around the lamps of a scene. Host object."""

    centre: mi.Point3f
    radius: mi.Float
    count: mi.UInt32

    @staticmethod
    def of(job: Job) -> ChainLamps | None:
        """None if no shape emits light."""
        lamps = lamp_balls(job)
        if not lamps:
            return None
        centres = np.array([lamp.centre for lamp in lamps], np.float32).T
        centre = mi.Point3f(*(uploaded(mi.Float, c) for c in centres))
        radius = uploaded(mi.Float, np.array([lamp.radius for lamp in lamps], np.float32))
        return ChainLamps(centre, radius, varying(mi.UInt32, len(lamps)))

    def between(self, line: mi.UInt32, a: tuple, b: tuple) -> tuple[mi.Float, mi.Float]:
        """`(share of the way from a to b, how near to the lamp [its radius])` for the lamp that `line` looks for.

        `a`, `b`: ray and surface interaction of each. Infinitely far if the lamp is behind what is met, or the start.
        """
        number = line % self.count
        c, radius = dr.gather(mi.Point3f, self.centre, number), dr.gather(mi.Float, self.radius, number)
        passed, offsets = mi.Bool(True), []
        for ray, si in (a, b):
            along = dr.dot(c - ray.o, ray.d)
            passed &= (along > 0) & (along < si.t + radius)
            offsets.append(ray.o + along * ray.d - c)
        e_a, step = offsets[0], offsets[1] - offsets[0]
        share = -dr.dot(e_a, step) / dr.squared_norm(step)
        near = passed & (share > 0) & (share < 1)
        return share, dr.select(near, dr.norm(e_a + share * step) / radius, dr.inf)
