"""How noisy is each term, in each form? Measured with a few samples of a probe's motion, and kept.

What is measured (`plan/probe_motion.py`) is the same for forward and backward mode, and its random numbers are its
own: weights made from it leave every estimate unbiased. Costs are counted, not timed, so that a seed gives the same
image on any machine. Samples of boundary terms are stratified along the edges: the variance of a term falls as n^-p,
p between 1 and 3, which two sample counts tell. The budgets minimise Σ V_t(n_t) at the cost Σ C_t n_t of equal
budgets, hence

    p_t V_t(n_t) / (C_t n_t) = λ        for all terms, λ found by bisection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import sampled_window
from ..core.line_guide import LEAST_GAIN, LineGuide, LineTally
from ..options import FOLLOWING, of_vertices
from ..plan.job import Job
from .film_noise import FilmNoise, coarse
from .terms import TERMS

#: Independent images per term and sample count, and the paths per pixel of each.
IMAGES, FEW, MORE = 3, 1, 4

#: Seeds of the pilot: far from those that a loop counts up from 0.
FIRST_SEED = 0x5EED0000

#: Derivative calls after which the pilot is run again, as the scene has changed: a power of two, see `noise_log`.
REFRESH = 256

#: Least and largest number of a term's paths relative to equal budgets: the pilot may have missed something rare.
LEAST, MOST = 1 / 8, 8.0

#: From here on a guide over one random number takes more from well spread samples than it gives: it goes by their
#: second moment, and they have much less variance than that.
STRATIFIED = 1.1

#: Time of a path from a place on the film that moves, relative to one from a place that rests.
MOVING_PLACES = 1.3

#: Between independent samples and stratified ones of a smooth function of one variable.
SLOWEST, FASTEST = 1.0, 3.0


@dataclass(frozen=True)
class TermNoise:
    """Variance per pixel by paths per pixel: `at_more` · (n / MORE)^−p. `cost`: of a path, see `Term.cost`."""

    at_more: float
    p: float
    cost: float
    even_cost: float  # the same if paths are spread evenly over the film
    film: FilmNoise | None = None  # where it is noisy, if its samples are spread over the film
    lines: LineGuide | None = None  # which lines through edges are worth it, if it samples any
    gain: float = 1.0  # of their second moment, by that guide
    heard: LineTally | None = None  # what lines have brought, of which the guide is made
    least_gain: float = LEAST_GAIN  # from which there is a guide

    @staticmethod
    def between(few: float, more: float, cost: float) -> TermNoise:
        """From the variances at `FEW` and `MORE` paths."""
        p = math.log(few / more) / math.log(MORE / FEW) if few > 0 and more > 0 else SLOWEST
        return TermNoise(max(more, 0.0), min(max(p, SLOWEST), FASTEST), cost, cost)

    def spread(self, few: np.ndarray, more: np.ndarray, effort: np.ndarray | None) -> TermNoise:
        """With samples where the film is noisy: as much better as one half of the pilot, (H, W), tells of the other."""
        told = FilmNoise.of({FEW: few}, IMAGES, effort).density
        gain = max(1.0, told.gain(more)) if told is not None else 1.0
        return replace(self, at_more=self.at_more / gain, film=FilmNoise.of({FEW: few, MORE: more}, IMAGES, effort))

    def measured(self, cost_of_segment: float) -> TermNoise:
        """With the cost of what its samples trace."""
        even = float(self.film.effort.mean())
        return replace(self, cost=cost_of_segment * self.film.segments, even_cost=cost_of_segment * even)

    def guided(self) -> TermNoise:
        """With lines as they have been found worth; as much better as one half of what was heard tells of the other."""
        if self.heard is None:
            return self
        lines, gain = self.heard.guide(self.least_gain)
        return replace(self, at_more=self.at_more * self.gain / gain, lines=lines, gain=gain)

    def at(self, n: float) -> float:
        return self.at_more * (n / MORE) ** -self.p

    def observed(self, variance: float, n: int, weight: float) -> TermNoise:
        """Moved by `weight` towards a variance that was seen at n paths."""
        seen = variance * (n / MORE) ** self.p
        return replace(self, at_more=(1 - weight) * self.at_more + weight * seen)

    def wish(self, price: float, least: float, most: float) -> float:
        """Paths at which one more is worth `price` times its cost."""
        gain = self.p * self.at_more * MORE**self.p / (self.cost * price)
        return min(max(gain ** (1 / (self.p + 1)), least), most)


@dataclass(frozen=True)
class Measurement:
    """Noise by form and name of the term."""

    noise: Mapping[str, Mapping[str, TermNoise]]

    def observed(self, form: str, name: str, variance: float, n: int, weight: float) -> Measurement:
        """See `TermNoise.observed`."""
        terms = {**self.noise[form], name: self.noise[form][name].observed(variance, n, weight)}
        return Measurement({**self.noise, form: terms})

    def seen_on_film(self, form: str, name: str, variance: np.ndarray, n: int, calls: int) -> Measurement:
        """See `FilmNoise.seen`."""
        term = self.noise[form][name]
        if term.film is None:
            return self
        terms = {**self.noise[form], name: replace(term, film=term.film.seen(variance, n, calls))}
        return Measurement({**self.noise, form: terms})

    def guided(self, form: str, fade: float) -> Measurement:
        """With guides of `form`, the one that runs, made anew; what they were made of counts for the share `fade` of
        itself from now on.
        """
        terms = {name: term.guided() for name, term in self.noise[form].items()}
        for term in terms.values():
            if term.heard is not None:
                term.heard.fade(fade)
        return Measurement({**self.noise, form: terms})

    def allocate(self, form: str, spp: Mapping[str, int], names: Iterable[str]) -> dict[str, int]:
        """Paths per pixel by term, with the least variance at the cost of `spp`; only those of `names` change."""
        terms = {name: self.noise[form][name] for name in self.noise[form] if name in names}
        total = sum(t.even_cost * spp[name] for name, t in terms.items())
        if not any(t.at_more > 0 for t in terms.values()):
            return dict(spp)

        def wishes(price: float) -> dict[str, float]:
            return {name: t.wish(price, LEAST * spp[name], MOST * spp[name]) for name, t in terms.items()}

        low, high = -80.0, 80.0  # logarithms of the price
        for _ in range(60):
            middle = (low + high) / 2
            found = wishes(math.exp(middle))
            cheap = sum(terms[name].cost * n for name, n in found.items()) > total
            low, high = (middle, high) if cheap else (low, middle)
        return {**spp, **{name: max(1, round(n)) for name, n in found.items()}}

    def alike(self) -> Measurement:
        """Whose terms gain as little by more paths as in the form in which they do least: few samples tell no better,
        and at many paths a wrong p would decide which form is chosen.
        """
        forms = list(self.noise.values())
        slowest = {name: min(terms[name].p for terms in forms) for name in forms[0]}
        return Measurement({form: {name: replace(t, p=slowest[name]) for name, t in terms.items()}
                            for form, terms in self.noise.items()})  # fmt: skip

    def efficiency(self, form: str, spp: Mapping[str, int]) -> float:
        """Variance × cost with these budgets; the lower the better."""
        terms = self.noise[form].items()
        return sum(t.at(spp[name]) for name, t in terms) * sum(t.cost * spp[name] for name, t in terms)


def measure(
    job_of: Callable[[str, int, int], Job], forms: Iterable[str], names: Iterable[str], sky: bool, guide: str = "auto"
) -> Measurement:
    """Run the pilot for `forms` and the terms `names`. `job_of(form, seed, spp)`: a job with a probe's motion.

    `guide`: one of `options.GUIDES`.
    """
    found: dict[str, dict[str, TermNoise]] = {}
    for form in forms:
        found[form] = {}
        for term in (t for t in TERMS if t.name in names):
            tally = LineTally() if term.guided and guide != "off" else None
            traced = [] if term.cost_of_segment is not None else None
            few, more = (
                _variance([term.forward(replace(job_of(form, FIRST_SEED + k, spp), tally=tally, effort=traced))
                           for k in range(IMAGES)])
                for spp in (FEW, MORE)
            )  # fmt: skip
            job = job_of(form, FIRST_SEED, FEW)
            dearer = term.with_light if job.light is not None else 1
            cost = dearer * term.cost(of_vertices(form), sky) * (MOVING_PLACES if form in FOLLOWING else 1)
            noise = TermNoise.between(float(few.mean()), float(more.mean()), cost)
            if term.over_film:
                noise = noise.spread(few, more, _effort(traced, job) if traced else None)
            if traced:
                noise = noise.measured(dearer * term.cost_of_segment)
            if term.guided > 1 or noise.p < STRATIFIED or guide == "on":
                least = 0.0 if guide == "on" else LEAST_GAIN
                noise = replace(noise, heard=tally, least_gain=least).guided()
            found[form][term.name] = noise
    return Measurement(found)


def _effort(traced: list[np.ndarray], job: Job) -> np.ndarray:
    """What a sample traces, by pixel or block of pixels, (H, W) [segments]. `traced`: by all of a pilot together."""
    lower, _ = sampled_window(job.film)
    columns, rows = job.film.crop_size()
    left, top = (int(n) for n in job.film.crop_offset() - lower)
    total = sum(traced)[top : top + rows, left : left + columns]
    return coarse(total / ((FEW + MORE) * IMAGES))


def variance_of_pair(a: mi.TensorXf, b: mi.TensorXf) -> mi.TensorXf:
    """Of each pixel, (H, W), the mean over its channels: the variance of which two images are samples."""
    return dr.mean(dr.square(a - b), axis=-1) / 2


def _variance(images: list[mi.TensorXf]) -> np.ndarray:
    """Of each pixel or block of pixels, (H, W), the mean over its channels: the variance between images."""
    mean = sum(images[1:], images[0]) / len(images)
    spread = sum(dr.square(image - mean) for image in images) / (len(images) - 1)
    return coarse(np.array(spread, np.float64).mean(-1))
