"""Samples of the film: as many as were asked for, in the pixels where they are wanted, and none without."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core import film as films
from psdr_jit.core.film_samples import EVEN_SHARE, FilmDensity, FilmSamples

SPP, WIDTH, HEIGHT = 8, 6, 5


def film(**more) -> mi.Film:
    return mi.load_dict({"type": "hdrfilm", "pixel_format": "rgb", **{"width": WIDTH, "height": HEIGHT, **more}})


def noisy_corner() -> FilmDensity:
    variance = np.full((HEIGHT, WIDTH), 1e-6)
    variance[0, 0] = 1.0
    return FilmDensity.of(variance)


def counts_of(samples: FilmSamples) -> np.ndarray:
    pixel, _ = samples.place(dr.arange(mi.UInt32, samples.count))
    return np.bincount(np.array(pixel), minlength=samples.size[0] * samples.size[1]).reshape(samples.size[::-1])


def test_every_pixel_has_its_share_and_the_noisy_ones_the_rest(llvm):
    counts = counts_of(FilmSamples.over(film(), SPP, noisy_corner()))
    assert counts.sum() == SPP * WIDTH * HEIGHT
    assert counts.min() == EVEN_SHARE * SPP
    assert counts[:2, :2].min() > 3 * SPP


def test_fewer_where_a_sample_is_dear(llvm):
    """n ∝ √(variance / cost), but for the even share."""
    effort = np.ones((HEIGHT, WIDTH))
    effort[:, WIDTH // 2 :] = 16.0
    even = FilmDensity.of(np.ones_like(effort)).expected
    left, right = FilmDensity.of(np.ones_like(effort), effort).expected[:, [0, -1]].T
    assert np.allclose(even, 1, atol=0.01)
    assert np.allclose((left - EVEN_SHARE) / (right - EVEN_SHARE), 4, rtol=0.1)


def test_sums_by_pixel(llvm):
    samples = FilmSamples.over(film(), SPP, noisy_corner())
    lane = dr.arange(mi.UInt32, samples.count)
    assert (samples.by_pixel(lane, mi.UInt32(1)) == counts_of(samples)).all()


def test_text_and_back(llvm):
    """Another process that is given the text draws the same numbers of samples."""
    density = noisy_corner()
    again = FilmDensity(density.shape, density.levels)
    assert again == density and (again.counts(film(), SPP) == density.counts(film(), SPP)).all()


def test_other_films_take_the_same_place(llvm):
    counts = noisy_corner().counts(film(width=2 * WIDTH, height=2 * HEIGHT), SPP)
    assert counts.shape == (2 * HEIGHT, 2 * WIDTH) and counts.sum() == SPP * counts.size
    assert counts[:4, :4].min() > 3 * SPP > 2 * counts[5:, 5:].max()


def test_numbers_within_a_pixel_count_up_from_zero(llvm):
    samples = FilmSamples.over(film(), SPP, noisy_corner())
    pixel, number = (np.array(v) for v in samples.place(dr.arange(mi.UInt32, samples.count)))
    for p in range(WIDTH * HEIGHT):
        assert (number[pixel == p] == np.arange((pixel == p).sum())).all()
    n = np.array(samples.in_pixel(dr.arange(mi.UInt32, samples.count)))
    assert (n == np.bincount(pixel)[pixel]).all()
    assert np.allclose(samples.weight(), SPP / n)


@pytest.mark.parametrize("crop", [{}, {"crop_offset_x": 2, "crop_offset_y": 1, "crop_width": 3, "crop_height": 4}])
def test_the_border_that_a_filter_samples_has_samples_too(llvm, crop):
    target = film(rfilter={"type": "gaussian"}, sample_border=True, **crop)
    h, w = (int(n) for n in reversed(target.crop_size()))
    density = FilmDensity.of(np.arange(1.0, h * w + 1).reshape(h, w))
    counts = counts_of(FilmSamples.over(target, SPP, density))
    lower, upper = films.sampled_window(target)
    assert counts.shape == tuple(int(n) for n in (upper - lower)[::-1])
    assert counts.min() >= 1 and counts.sum() == SPP * counts.size


def test_one_sample_per_pixel_is_not_moved(llvm):
    assert (counts_of(FilmSamples.over(film(), 1, noisy_corner())) == 1).all()


def test_a_film_without_noise_has_no_wishes():
    assert FilmDensity.of(np.zeros((HEIGHT, WIDTH))) is None
    assert FilmDensity.of(np.full((HEIGHT, WIDTH), np.nan)) is None


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_means_are_those_of_even_samples(llvm, rfilter):
    """A smooth function over the film: whatever the density, the image estimates the same; a lost weight would show."""
    target = film(rfilter={"type": rfilter})
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    images = []
    for density in (None, FilmDensity.of(1.0 + (x % 3) * 40.0 + y)):
        samples = FilmSamples.over(target, 512, density)
        lane = dr.arange(mi.UInt32, samples.count)
        rng = samples.sampler(mi.UInt32(3), lane)
        p = samples.corner_of(samples.place(lane)[0]) + rng.next_2d()
        at = films.FilmPoints(p, samples.weight(), True)
        images.append(np.array(films.develop_samples(target, at, mi.Spectrum(p.x + 2 * p.y), mi.Color0f())))
    assert np.allclose(*images, atol=0.02)
    assert np.ptp(images[0]) > 5


def test_pixels_have_sequences_of_their_own(llvm):
    side, spp = 32, 16
    samples = FilmSamples.over(film(width=side, height=side), spp)
    sampler = samples.sampler(mi.UInt32(9), dr.arange(mi.UInt32, samples.count))
    points = np.array(sampler.next_2d()).T.reshape(-1, spp, 2)
    for block in points:
        assert np.histogram2d(*block.T, bins=(4, 4), range=[[0, 1], [0, 1]])[0].max() == 1
    assert len(np.unique(points[:, 0, 0])) > len(points) * 0.99
