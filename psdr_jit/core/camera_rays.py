"""Camera rays as Mitsuba's renderers draw them, with as many samples in each pixel as one wants."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .film_samples import FilmSamples
from .low_discrepancy import LaneSampler


@dataclass
class RayNumbers:
    """What is random about a camera ray beside its place on the film. Detached."""

    aperture: mi.Point2f
    time: mi.Float  # when the shutter is open
    wavelength: mi.Float

    @staticmethod
    def draw(sensor: mi.Sensor, rng: LaneSampler) -> RayNumbers:
        """In the order of `ADIntegrator.sample_rays`."""
        aperture = rng.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
        time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0:
            time += rng.next_1d() * sensor.shutter_open_time()
        return RayNumbers(aperture, time, rng.next_1d() if mi.is_spectral else mi.Float(0))


def rays_at(sensor: mi.Sensor, p: mi.Point2f, numbers: RayNumbers) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
    """`(rays, weights)` of the film positions `p` [px]; attached to the sensor."""
    film = sensor.film()
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    with dr.resume_grad():
        return sensor.sample_ray_differential(
            time=numbers.time, sample1=numbers.wavelength, sample2=dr.fma(p, scale, offset), sample3=numbers.aperture
        )


def camera_rays(
    sensor: mi.Sensor, samples: FilmSamples, rng: LaneSampler, lane: mi.UInt32
) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Point2f]:
    """`(rays, weights, film positions [px])` of the samples `lane`; attached to the sensor.

    The positions are those that `film.develop_samples` wants: with a box filter the corner of the pixel, as a sum
    rounded up would be in the next one. Random numbers are used in the order of `ADIntegrator.sample_rays`.
    """
    pixel, _ = samples.place(lane)
    corner = samples.corner_of(pixel)
    p = corner + rng.next_2d()
    ray, weight = rays_at(sensor, p, RayNumbers.draw(sensor, rng))
    return ray, weight, corner if sensor.film().rfilter().is_box_filter() else p
