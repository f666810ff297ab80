"""A sensor that sees what another one sees, by stratified random numbers.

What moves a little changes few samples of a pixel, and a sampler that stratifies leaves less to chance where these lie:
differences with common random numbers have a half to a twentieth of the variance in the same time, the more samples the
less. Outlines gain the most, shadows of wide lamps and longer paths the least.
"""

from __future__ import annotations

from functools import cache
from math import isqrt
from typing import Any

import mitsuba as mi

SAMPLER = "multijitter"  # correlated multi-jittered: numbers drawn in pairs are stratified in both [Kensler 2013]


def stratified_count(spp: int) -> int:
    """The least number of samples, `spp` or a few more, that Mitsuba's sampler lays out as rows and columns."""
    rows = isqrt(spp)
    return rows * -(-spp // rows)


def stratified(sensor: mi.Sensor, spp: int, sampler: str = SAMPLER) -> mi.Sensor:
    """`sensor`, the same object with all its parameters, with another sampler. `spp` as `stratified_count` returns it.

    Samples of a pixel depend on each other, those of different seeds do not: errors come from the scatter of seeds.
    """
    given = mi.Properties("stratified")
    given["film"] = sensor.film()
    given["sampler"] = mi.load_dict({"type": sampler, "sample_count": spp})
    given["shutter_open"] = sensor.shutter_open()
    given["shutter_close"] = sensor.shutter_open() + sensor.shutter_open_time()
    view = _stratified_class(mi.variant())(given)
    view.see_through(sensor)
    return view


@cache
def _stratified_class(variant: str) -> type:
    """Mitsuba's base classes are others in every variant."""

    class Stratified(mi.Sensor):
        """Hands every question about rays to the sensor that it stands for."""

        def see_through(self, sensor: mi.Sensor) -> None:
            self.seen_through = sensor
            self.m_needs_sample_3 = sensor.needs_aperture_sample()

        def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple:
            return self.seen_through.sample_ray(time, sample1, sample2, sample3, active)

        def sample_ray_differential(self, time: Any, sample1: Any, sample2: Any, sample3: Any,
                                    active: Any = True) -> tuple:  # fmt: skip
            return self.seen_through.sample_ray_differential(time, sample1, sample2, sample3, active)

        def to_string(self) -> str:
            return f"Stratified[{self.seen_through}]"

    return Stratified
