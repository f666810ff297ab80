"""The lines on the film that are searched for steps of what is seen in mirrors and behind glass (`chain_search`).

Every sample is a line across one pixel, horizontal or vertical. What its chains have in common, the directions in
which they leave smooth vertices, is drawn before they are traced (`chain_fixed`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.film_samples import FilmSamples
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..paths.rays import skip_emitters
from ..plan.job import Job
from .chain_aims import ChainAims
from .chain_fixed import Directions
from .chain_trace import compare_light
from .chain_world import ChainWorld
from .searched_lines import SearchedLines, either

#: Intervals as short as this [px] are not cut: what is narrower, such as the last bit of a tip, is not looked for.
NARROWEST = 2.0**-10

#: Width at which halving ends [px], or relative to the film: some units in the last place of a float32 film position.
#: What a ball mirrors closer than that to its outline is missing: its share of a pixel goes by the root of the width.
LEAST_WIDTH, ROUNDING = 2.0**-16, 5e-7


@dataclass
class Line:
    """The line of a sample on the film. Detached."""

    start: mi.Point2f  # film position [px]
    horizontal: mi.Bool
    aperture: mi.Point2f
    wavelength: mi.Float  # random number
    lobe: mi.Float  # another one

    def at(self, s: mi.Float) -> mi.Point2f:
        """Film position [px] a share `s` of the way along."""
        return self.start + dr.select(self.horizontal, mi.Point2f(s, 0), mi.Point2f(0, s))


@dataclass(frozen=True)
class Lines(SearchedLines):
    """The lines of a job, `job.spp` across a pixel, half of them horizontal on average. Host object."""

    job: Job
    world: ChainWorld
    samples: FilmSamples
    directions: Directions  # of their smooth vertices
    narrowest = NARROWEST
    first_kept = 1  # segment: what camera rays meet first is the primary boundary's

    @staticmethod
    def of(job: Job) -> Lines:
        world = ChainWorld.of(job, compare_light)
        if world.scatters:
            world = replace(world, aims=ChainAims.of(job))
        samples = FilmSamples.over(job.film, job.spp, job.density)
        lines = Lines(job, world, samples, Directions(samples.count if world.scatters else 0, world.depth))
        lines.guide()
        return lines

    def line(self, sample: mi.UInt32) -> Line:
        rng = self.samples.sampler(stream_seed(self.job.seed, Stream.CHAIN_LINE), sample)
        corner = self.samples.corner_of(self.samples.place(sample)[0])
        u = rng.next_2d()  # together: half of the lines are horizontal, and their offsets well spread among themselves
        (horizontal, lobe), offset = either(u.x), u.y
        aperture, wavelength = rng.next_2d(), rng.next_1d()
        start = corner + dr.select(horizontal, mi.Point2f(0, offset), mi.Point2f(offset, 0))
        return Line(start, horizontal, aperture, wavelength, lobe)

    def per_pixel(self, sample: mi.UInt32) -> mi.Float:
        """Expected number of lines of one direction across the pixel of a line."""
        return self.samples.in_pixel(sample) / 2

    def tell_effort(self, sample: mi.UInt32, segments: mi.UInt32) -> None:
        if self.job.effort is not None:
            self.job.effort.append(self.samples.by_pixel(sample, segments))

    @property
    def count(self) -> int:
        """Number of lines."""
        return self.samples.count

    def film(self, p: mi.Point2f) -> mi.Point2f:
        """Film position p [px] in [0, 1]² of the crop window."""
        frame = self.job.frame
        return (p - varying(mi.Point2f, frame.crop_offset)) / varying(mi.Point2f, frame.crop_size)

    def ray(self, line: Line, s: mi.Float) -> mi.Ray3f:
        """The camera ray, behind the emitters that are hidden from the camera."""
        ray, _ = self.job.sensor.sample_ray(0, line.wavelength, self.film(line.at(s)), line.aperture)
        if not self.job.options.hide_emitters:
            return mi.Ray3f(ray)
        return skip_emitters(self.job.scene, ray, self.job.scene.ray_intersect_preliminary(ray))[0]

    @property
    def least_width(self) -> mi.Float:
        return varying(mi.Float, max(LEAST_WIDTH, ROUNDING * max(self.job.frame.crop_size)))
