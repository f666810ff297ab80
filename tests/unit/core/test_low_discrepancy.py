"""Random numbers: every pair is a (0, m, 2)-net, pairs are unrelated, and each number is uniform over seeds."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

LOG_COUNT = 12
COUNT = 1 << LOG_COUNT


def pairs(key: int, number: int):
    from psdr_jit.core.low_discrepancy import lane_sampler

    sampler = lane_sampler(mi.UInt32(key), dr.arange(mi.UInt32, COUNT))
    return [np.array(sampler.next_2d()).T for _ in range(number)]


@pytest.mark.parametrize("key", [0, 77])
def test_each_pair_is_a_net(variant, key):
    """Every way to cut the square into COUNT equal boxes with power-of-two sides puts one point into each."""
    for points in pairs(key, 3):
        for m in range(LOG_COUNT + 1):
            bins = (1 << m, 1 << (LOG_COUNT - m))
            cells = np.histogram2d(*points.T, bins=bins, range=[[0, 1], [0, 1]])[0]
            assert cells.min() == cells.max() == 1


def test_each_stretch_of_lanes_is_stratified(variant):
    """Lanes are sorted along edges: an aligned block of 64 must be spread over the whole square by itself."""
    for points in pairs(5, 3):
        for block in points.reshape(-1, 64, 2):
            assert np.histogram2d(*block.T, bins=(8, 8), range=[[0, 1], [0, 1]])[0].max() == 1


def test_pairs_are_unrelated(variant):
    columns = np.concatenate(pairs(1, 4), axis=1)
    correlation = np.corrcoef(columns.T) - np.eye(8)
    assert np.abs(correlation).max() < 5 / np.sqrt(COUNT)


def test_numbers_are_uniform_over_keys(variant):
    """One lane, many keys: mean, variance and correlation of a pair as of independent uniform numbers."""
    from psdr_jit.core.low_discrepancy import LaneSampler

    keys = mi.sample_tea_32(dr.arange(mi.UInt32, COUNT), mi.UInt32(3))[0]
    for index in (0, 1, 12345):
        sampler = LaneSampler(mi.UInt32(index), keys)
        values = np.stack([*np.array(sampler.next_2d()), np.array(sampler.next_1d())])
        assert np.abs(values.mean(1) - 0.5).max() < 5 * np.sqrt(1 / 12 / COUNT)
        assert np.abs(values.var(1) - 1 / 12).max() < 5 * np.sqrt(1 / 180 / COUNT)
        assert np.abs(np.corrcoef(values) - np.eye(3)).max() < 5 / np.sqrt(COUNT)
