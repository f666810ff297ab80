"""Camera rays as Mitsuba's renderers draw them, with as many samples in each pixel as one wants."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .ad import tangents
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


@dataclass
class RayPerPixel:
    """How a camera ray changes with its film position: derivatives by its two coordinates [1/px]. Detached."""

    o: tuple[mi.Vector3f, mi.Vector3f]
    d: tuple[mi.Vector3f, mi.Vector3f]

    def moved(self, shift: mi.Vector2f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Displacements `(of the origin, of the direction)` as the film position is displaced [px]."""
        o, d = (v[0] * shift.x + v[1] * shift.y for v in (self.o, self.d))
        return o, d


def film_position(sensor: mi.Sensor, p: mi.Point2f) -> mi.Point2f:
    """The film position `p` [px] in [0, 1]² of the crop window, as sensors want it."""
    film = sensor.film()
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    return dr.fma(p, scale, -mi.ScalarVector2f(film.crop_offset()) * scale)


def ray_per_pixel(sensor: mi.Sensor, p: mi.Point2f, numbers: RayNumbers) -> RayPerPixel:
    """Of the rays through the film positions `p` [px], whatever the sensor's own parameters do."""
    found = []
    for axis in ((1, 0), (0, 1)):
        q = mi.Point2f(dr.detach(p))
        with dr.resume_grad():
            dr.enable_grad(q)
            dr.set_grad(q, mi.Vector2f(axis))
        with dr.suspend_grad(), dr.resume_grad(q):
            ray, _ = sensor.sample_ray(numbers.time, numbers.wavelength, film_position(sensor, q), numbers.aperture)
            o, d = tangents(ray.o, ray.d)
        found.append((mi.Vector3f(o), mi.Vector3f(d)))
    return RayPerPixel(*zip(*found, strict=True))


def rays_at(sensor: mi.Sensor, p: mi.Point2f, numbers: RayNumbers) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
    """`(rays, weights)` of the film positions `p` [px]; attached to the sensor."""
    with dr.resume_grad():
        return sensor.sample_ray_differential(
            time=numbers.time, sample1=numbers.wavelength, sample2=film_position(sensor, p), sample3=numbers.aperture
        )


def camera_rays(
    sensor: mi.Sensor, samples: FilmSamples, rng: LaneSampler, lane: mi.UInt32
) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Point2f, mi.Point2f, RayNumbers]:
    """`(rays, weights, film positions, the same for the film, what else is random)` of the samples `lane`; attached to
    the sensor. Positions are in pixels.

    `film.develop_samples` wants them with a box filter in the corner of the pixel, as a sum rounded up would be in the
    next one. Random numbers are used in the order of `ADIntegrator.sample_rays`.
    """
    pixel, _ = samples.place(lane)
    corner = samples.corner_of(pixel)
    p = corner + rng.next_2d()
    numbers = RayNumbers.draw(sensor, rng)
    ray, weight = rays_at(sensor, p, numbers)
    return ray, weight, p, corner if sensor.film().rfilter().is_box_filter() else p, numbers
