"""One call of an integrator as data: who renders what, and what is remembered."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ..core.counters import Counters
from ..core.memory import Memory
from ..options import Options


@dataclass(frozen=True)
class Call:
    """A call of `render_forward` or `render_backward`. Host data only."""

    integrator: mi.CppADIntegrator  # provides Mitsuba's `sample_rays`
    scene: mi.Scene
    sensor: mi.Sensor
    film: mi.Film  # of the sensor, or of its size
    options: Options
    memory: Memory  # the integrator's: outlives the call
    counters: Counters
    seed: int | mi.UInt32
    spp: int  # 0: left to the options and the sampler
    mode: str = "forward"  # or "backward"
