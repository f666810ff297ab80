"""Figures of the benchmark, on synthetic images whose bias, variance and tails are known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import figures

SHAPE = (32, 32, 3)
NOISE, REFERENCE_NOISE = 0.5, 0.02


@pytest.fixture
def truth():
    return np.sin(np.arange(np.prod(SHAPE))).reshape(SHAPE)


def renders(mean, count, seed, noise=NOISE):
    return mean + noise * np.random.default_rng(seed).standard_normal((count, *SHAPE))


@pytest.fixture
def reference(truth):
    return figures.Reference(renders(truth, 2, 1, REFERENCE_NOISE), REFERENCE_NOISE**2 / 2)


def test_power_is_free_of_noise(truth, reference):
    assert reference.power == pytest.approx(np.mean(truth**2), rel=0.01)


def test_error_falls_with_the_root_of_time(truth, reference):
    curve = figures.error_curve(renders(truth, 64, 2), np.full(64, 0.25), reference)
    assert [point["renders"] for point in curve] == [1, 2, 4, 8, 16, 32, 64]
    assert curve[-1]["seconds"] == 16
    assert curve[0]["rmse"] == pytest.approx(NOISE / np.sqrt(np.mean(truth**2)), rel=0.02)
    assert curve[0]["rmse"] / curve[4]["rmse"] == pytest.approx(4, rel=0.05)


def test_curve_ends_with_every_render(truth, reference):
    curve = figures.error_curve(renders(truth, 5, 2), np.ones(5), reference)
    assert [point["renders"] for point in curve] == [1, 2, 4, 5]


@pytest.mark.parametrize("count", [2, 3, 40])
def test_bias_is_separated_from_variance(truth, reference, count):
    for share in (0.0, 0.5):
        images = renders((1 - share) * truth, count, 3)
        value, error = figures.squared_bias(images, reference)
        assert abs(value - share**2 * np.mean(truth**2)) < 4 * error
        assert figures.variance(images) == pytest.approx(NOISE**2, rel=0.1)
    assert value > 10 * error, "half of the derivative missing is seen even in two renders"


def test_tail_share_of_normal_noise_and_of_fireflies(truth):
    images = renders(truth, 16, 4)
    assert 0.003 < figures.tail_share(images) < 0.015
    images.reshape(-1)[::5000] += 1000
    assert figures.tail_share(images) > 0.9
    assert figures.tail_share(np.zeros((4, *SHAPE))) == 0


def test_error_after_a_time():
    assert figures.mean_squared_error_after(10, 0.5, 0.25, 4) == pytest.approx(0.25 + 0.2)
    assert figures.mean_squared_error_after(10, 0.5, -1e-9, 4) == pytest.approx(0.2)
