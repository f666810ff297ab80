"""Camera rays as Mitsuba's renderers draw them, with as many samples in each pixel as one wants."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .film_samples import FilmSamples
from .low_discrepancy import LaneSampler


def camera_rays(
    sensor: mi.Sensor, samples: FilmSamples, rng: LaneSampler, lane: mi.UInt32
) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Point2f]:
    """`(rays, weights, film positions [px])` of the samples `lane`; attached to the sensor.

    The positions are those that `film.develop_samples` wants: with a box filter the corner of the pixel, as a sum
    rounded up would be in the next one. Random numbers are used in the order of `ADIntegrator.sample_rays`.
    """
    film = sensor.film()
    pixel, _ = samples.place(lane)
    corner = samples.corner_of(pixel)
    p = corner + rng.next_2d()
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    aperture = rng.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += rng.next_1d() * sensor.shutter_open_time()
    wavelength = rng.next_1d() if mi.is_spectral else 0
    with dr.resume_grad():
        ray, weight = sensor.sample_ray_differential(
            time=time, sample1=wavelength, sample2=dr.fma(p, scale, offset), sample3=aperture
        )
    return ray, weight, corner if film.rfilter().is_box_filter() else p
