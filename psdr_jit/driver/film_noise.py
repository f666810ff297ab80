"""Where on the film a term is noisy: variances of single samples by pixel, from the pilot and from calls since.

Pixels are compared with each other only, so samples count as independent here; what stratification gains on top is in
the term's own law (`pilot.TermNoise`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.film_samples import FilmDensity, smoothed

#: Rows and columns of what is kept, at most: it travels with the plan. A pilot draws no more of them than that.
MOST_CELLS = 256

#: Least share of what was seen last: the scene changes as an optimisation goes on.
FORGET = 0.2

#: Of the pixels with noise, the share whose variance is believed; that of the others, the noisiest, counts as as much
#: as these have, or as `SEEN_TWICE` times what each of two independent estimates has found there.
BELIEVED, SEEN_TWICE = 0.95, 4.0


def pixels_per_cell(height: int, width: int) -> int:
    """Rows and columns of pixels that are one cell, so that there are `MOST_CELLS` a side at most."""
    return -(-max(height, width) // MOST_CELLS)


def coarse(image: np.ndarray) -> np.ndarray:
    """Means of an image (H, W) over cells, see `pixels_per_cell`."""
    n = pixels_per_cell(*image.shape)
    padded = np.pad(image, [(0, -size % n) for size in image.shape], mode="edge")
    return padded.reshape(padded.shape[0] // n, n, -1, n).mean((1, 3))


@dataclass(frozen=True, eq=False)
class FilmNoise:
    """What is known after some samples, of pixels or blocks of them (`coarse`). Host object."""

    variance: np.ndarray  # (H, W), of one sample
    samples: float  # per pixel: how many have told
    effort: np.ndarray | None = None  # (H, W), segments that a sample traces; None: all about the same

    @staticmethod
    def of(images: Mapping[int, np.ndarray], count: int, effort: np.ndarray | None = None) -> FilmNoise:
        """From variances (H, W) between `count` images, by their samples per pixel."""
        noise = [FilmNoise(spp * variance, (count - 1) * spp) for spp, variance in images.items()]
        total = sum(n.samples for n in noise)
        return FilmNoise(_believed([(n.variance, n.samples / total) for n in noise]), total, effort)

    @cached_property
    def density(self) -> FilmDensity | None:
        """Where samples are wanted; None: nowhere in particular."""
        return FilmDensity.of(self.variance, self.effort)

    @property
    def segments(self) -> float:
        """What a sample traces on average, spread by this density."""
        there = self.density.expected if self.density is not None else np.ones_like(self.effort)
        return float(np.mean(there * self.effort))

    def seen(self, variance: np.ndarray, spp: int, calls: int) -> FilmNoise:
        """With the mean variance (H, W) of `calls` images of `spp` samples per pixel, drawn by this density."""
        there = self.density.expected if self.density is not None else 1.0
        before = min(self.samples, calls * spp * (1 / FORGET - 1))
        new = calls * spp / (before + calls * spp)
        variance = _believed([(self.variance, 1 - new), (spp * there * variance, new)])
        return FilmNoise(variance, before + calls * spp, self.effort)


def _believed(estimates: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """The mean of independent estimates (variance (H, W), weight) but for what only one of them has met.

    A rare contribution is met in few of the pixels that have it: samples sent there are missing elsewhere.
    """
    mean = sum(weight * variance for variance, weight in estimates)
    noisy = mean[mean > 0]
    if not noisy.size:
        return mean
    by_all = np.minimum.reduce([smoothed(variance) for variance, _ in estimates])
    return np.minimum(mean, np.maximum(np.quantile(noisy, BELIEVED), SEEN_TWICE * by_all))
