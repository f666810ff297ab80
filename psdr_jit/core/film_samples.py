"""How many samples each pixel of the film gets: the same number everywhere, or more where a term is noisy.

In every pixel samples are uniform, and their numbers are settled before any of them is drawn: with 1/n_i on each of
n_i samples a pixel's mean is unbiased for any n_i ≥ 1. The variance Σ v_i/n_i of an image is least for n_i ∝ √v_i,
where v_i is that of one sample. It is known from a few samples only (`driver/pilot.py`), so a share of the samples
goes evenly to all pixels: what the pilot has missed costs at most 1/`EVEN_SHARE` times the variance it has anyway.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from .film import sampled_window
from .levels import packed, unpacked
from .low_discrepancy import LaneSampler
from .upload import uploaded
from .varying import varying

#: Share of the samples that is spread evenly; at least one in every pixel is.
EVEN_SHARE = 0.25

#: Noise, relative to the mean over the film, that pixels are believed to have on top: the pilot sees none in many.
LEAST_NOISE = 0.02

#: What a sample costs at least, relative to the mean over the film.
LEAST_EFFORT = 0.1


@dataclass(frozen=True)
class FilmDensity:
    """Wishes for samples relative to the mean number, on the pixels of the crop window. Host object, plain text."""

    shape: tuple[int, int]  # (H, W)
    levels: str  # the wishes, see `levels.packed`

    @staticmethod
    def of(variance: np.ndarray, effort: np.ndarray | None = None) -> FilmDensity | None:
        """√(variance of each pixel), (H, W), with that of its neighbours; None where there is no noise.

        `effort`, (H, W): what a sample costs there, which then is least for √(variance / effort); None: all the same.
        """
        spread = np.sqrt(smoothed(np.asarray(variance, np.float64)))
        if effort is not None:
            spread /= np.sqrt(smoothed(np.maximum(effort, LEAST_EFFORT * effort.mean())))
        if not spread.mean() > 0 or not np.isfinite(spread).all():
            return None
        return FilmDensity(tuple(spread.shape), packed(spread / spread.mean() + LEAST_NOISE))

    @cached_property
    def relative(self) -> np.ndarray:
        """(H, W), mean 1."""
        return unpacked(self.levels, self.shape)

    def counts(self, film: mi.Film, spp: int) -> np.ndarray:
        """Samples of each pixel of the sampled window, (H, W) of integers ≥ 1, `spp` on average.

        On another film it is that of the same place in its crop window; beside it that of the nearest pixel.
        """
        lower, upper = sampled_window(film)
        columns, rows = (
            np.clip(((np.arange(lo, hi) + 0.5 - first) * n / size).astype(int), 0, n - 1)
            for lo, hi, first, size, n in zip(lower, upper, film.crop_offset(), film.crop_size(), self.shape[::-1],
                                              strict=True)  # fmt: skip
        )
        wish = self.relative[np.ix_(rows, columns)].ravel()
        even = max(1, round(EVEN_SHARE * spp))
        upto = np.cumsum(wish) * ((spp - even) * wish.size / wish.sum())
        extra = np.diff(np.floor(upto + 0.5), prepend=0).astype(np.int64)
        return even + extra.reshape(len(rows), len(columns))

    @property
    def expected(self) -> np.ndarray:
        """Samples of each pixel relative to the mean, (H, W), if there are many."""
        return EVEN_SHARE + (1 - EVEN_SHARE) * self.relative

    def gain(self, variance: np.ndarray) -> float:
        """By which factor the mean of `variance` (H, W) of equally many samples falls, if there are many."""
        mean = float(np.mean(variance / self.expected))
        return float(np.mean(variance)) / mean if mean > 0 else 1.0


def smoothed(variance: np.ndarray) -> np.ndarray:
    """Mean over the pixel and its neighbours, as far as there are any."""
    rows, columns = variance.shape
    padded = np.pad(variance, 1, mode="edge")
    return sum(padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)) / 9


@dataclass(frozen=True, eq=False)
class FilmSamples:
    """Samples of one pass, pixel after pixel: lane → pixel. Host object, not loop state."""

    corner: tuple[float, float]  # of the sampled window [px]
    size: tuple[int, int]  # its width and height [px]
    spp: int  # on average
    first: mi.UInt32  # lane of the first sample of every pixel, and of one more
    pixels: mi.UInt32  # pixel of every lane

    @staticmethod
    def over(film: mi.Film, spp: int, density: FilmDensity | None = None) -> FilmSamples:
        """`spp` samples per pixel of the sampled window of `film`, spread as `density` wishes.

        Where they are spread evenly that is stored all the same: a pilot's kernels are then those of later calls.
        """
        lower, upper = sampled_window(film)
        corner, size = tuple(map(float, lower)), tuple(int(n) for n in upper - lower)
        count = size[0] * size[1]
        if density is None or spp < 2:
            per_pixel = varying(mi.UInt32, spp)
            first, pixels = dr.arange(mi.UInt32, count + 1) * per_pixel, dr.arange(mi.UInt32, count * spp) // per_pixel
        else:
            counts = density.counts(film, spp).ravel()
            first = uploaded(mi.UInt32, np.concatenate([[0], np.cumsum(counts)]))
            begins = dr.zeros(mi.UInt32, int(counts.sum()))
            dr.scatter(begins, mi.UInt32(1), dr.gather(mi.UInt32, first, dr.arange(mi.UInt32, count - 1) + 1))
            pixels = dr.cumsum(begins)
        dr.eval(first, pixels)
        return FilmSamples(corner, size, spp, first, pixels)

    def by_pixel(self, lane: mi.UInt32, value: mi.UInt32) -> np.ndarray:
        """(H, W) of the sampled window: sums of a `value` of each sample `lane`. Waits for them."""
        columns, rows = self.size
        sums = dr.zeros(mi.Float, columns * rows)
        dr.scatter_add(sums, mi.Float(value), self.place(lane)[0])
        return np.array(sums, np.float64).reshape(rows, columns)

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.size[0] * self.size[1] * self.spp

    def place(self, lane: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """`(pixel, number among its samples)`."""
        pixel = dr.gather(mi.UInt32, self.pixels, lane)
        return pixel, lane - dr.gather(mi.UInt32, self.first, pixel)

    def sampler(self, seed: mi.UInt32, lane: mi.UInt32) -> LaneSampler:
        """A sequence of random numbers for every pixel, well spread over its samples."""
        pixel, number = self.place(lane)
        return LaneSampler(number, mi.sample_tea_32(seed, pixel)[0])

    def corner_of(self, pixel: mi.UInt32) -> mi.Point2f:
        """Film position of the upper left corner of `pixel` [px]."""
        width = varying(mi.UInt32, self.size[0])
        row = pixel // width
        return mi.Point2f(mi.Float(pixel - row * width), mi.Float(row)) + varying(mi.Point2f, self.corner)

    def in_pixel(self, lane: mi.UInt32) -> mi.Float:
        """Number of samples of the pixel of `lane`."""
        pixel = dr.gather(mi.UInt32, self.pixels, lane)
        return mi.Float(dr.gather(mi.UInt32, self.first, pixel + 1) - dr.gather(mi.UInt32, self.first, pixel))

    def at(self, p: mi.Point2f) -> mi.Float:
        """Number of samples of the pixel around the film position `p` [px]; 0 outside of the sampled window."""
        place = dr.floor(p - varying(mi.Point2f, self.corner))
        width, height = (varying(mi.Float, n) for n in self.size)
        inside = (place.x >= 0) & (place.y >= 0) & (place.x < width) & (place.y < height)
        pixel = mi.UInt32(place.y) * mi.UInt32(width) + mi.UInt32(place.x)
        last = dr.gather(mi.UInt32, self.first, pixel + 1, inside)
        return dr.select(inside, mi.Float(last - dr.gather(mi.UInt32, self.first, pixel, inside)), 0)

    def weight(self) -> mi.Float:
        """Of every sample, for means: 1 on average over the film."""
        return varying(mi.Float, self.spp) / self.in_pixel(dr.arange(mi.UInt32, self.count))
