"""Samples of the film, with their camera rays, in passes whose records fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.camera_rays import RayPerPixel, camera_rays, ray_per_pixel
from ..core.film_samples import FilmSamples
from ..core.low_discrepancy import LaneSampler
from ..core.streams import Stream, stream_seed
from ..paths.recording import PathRecords
from ..plan.job import Job, passes

#: Samples per pixel from which the film adds up those of a pixel before it writes.
COALESCED = 4

#: Recorded depth assumed for unlimited paths when the wavefront is split; the actual depth is measured.
NOMINAL_DEPTH = 16


@dataclass(frozen=True)
class CameraPass:
    """Camera samples of one pass; `ray` is attached to the sensor, everything else detached."""

    samples: FilmSamples
    share: float  # of the term's samples
    seed: mi.UInt32
    ray: mi.RayDifferential3f
    weight: mi.Spectrum
    at: films.FilmPoints
    p: mi.Point2f  # where rays begin on the film, if that moves [px]
    per_px: RayPerPixel | None  # where film positions move

    sought = False  # which of them meet what moves is not known

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.samples.count

    def sampler(self, lane: mi.UInt32) -> LaneSampler:
        """What is random about the paths of these samples."""
        return self.samples.sampler(self.seed, lane)

    def of(self, lane: mi.UInt32) -> CameraPass:
        """What is known of the samples `lane`, in place of all: rays, weights and places on the film."""
        if dr.width(lane) == self.count:
            return self
        at = films.FilmPoints(dr.gather(mi.Point2f, self.at.p, lane), dr.gather(mi.Float, self.at.weight, lane), False)
        ray, weight = dr.gather(type(self.ray), self.ray, lane), dr.gather(mi.Spectrum, self.weight, lane)
        per_px = None if self.per_px is None else dr.gather(type(self.per_px), self.per_px, lane)
        p = dr.gather(mi.Point2f, self.p, lane)
        return replace(self, ray=ray, weight=weight, at=at, p=p, per_px=per_px)

    def develop(self, film: mi.Film, value: mi.Spectrum) -> mi.TensorXf:
        """Image of what the samples bring."""
        return films.develop_samples(film, self.at, value * self.weight, self.ray.wavelengths)

    def adjoint(self, film: mi.Film, grad_in: mi.TensorXf) -> mi.Spectrum:
        """Of `develop`: derivative of ⟨grad_in, image⟩ with respect to each value."""
        return self.weight * films.sample_adjoint(film, self.at, grad_in, self.ray.wavelengths)


def camera_passes(job: Job) -> Iterator[CameraPass]:
    """Camera rays, in passes whose path records fit into `record_mib`."""
    film = job.film
    lower, upper = films.sampled_window(film)
    pixels = int((upper - lower).prod())
    depth = max(1, min(job.options.depth_limit, NOMINAL_DEPTH))
    size = PathRecords.BYTES_RGB * depth * (1 if job.light is None else 1 + job.plan.light.per_sample)
    for share, part in passes(job, size, pixels):
        films.clear(film)
        samples = FilmSamples.over(film, part.spp, part.density)
        lane = dr.arange(mi.UInt32, samples.count)
        rng = samples.sampler(stream_seed(part.seed, Stream.CAMERA), lane)
        ray, weight, p, place, numbers = camera_rays(job.sensor, samples, rng, lane)
        per_px = None if job.film_flow is None else ray_per_pixel(job.sensor, p, numbers)
        at = films.FilmPoints(place, samples.weight(), part.spp >= COALESCED)
        # at once: films are written and read after paths are traced
        dr.eval(dr.detach(ray), weight, place, at.weight, per_px, *([] if per_px is None else [p]))
        yield CameraPass(samples, share, stream_seed(part.seed, Stream.INTERIOR), ray, weight, at, p, per_px)
