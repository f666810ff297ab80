"""What a term needs to know to do its share of one derivative render."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from .options import Options
from .path_steps import PathLimits
from .rejected import Rejected
from .scene_analysis import SceneFacts


@dataclass(frozen=True)
class Job:
    """One term's share of a render call. Host data only; `spp` is the term's own budget."""

    integrator: mi.CppADIntegrator  # provides Mitsuba's `prepare` and `sample_rays`
    scene: mi.Scene
    sensor: mi.Sensor
    facts: SceneFacts
    options: Options
    cache: dict  # the integrator's: edge sets that outlive a call
    rejected: Rejected  # the integrator's: counts dropped samples
    seed: int | mi.UInt32
    spp: int

    @property
    def film(self) -> mi.Film:
        return self.sensor.film()

    @property
    def limits(self) -> PathLimits:
        return PathLimits(self.options.depth_limit, self.options.rr_depth)
