"""The edge distribution samples what its `pmf` says: exact strata, a χ² test, and no row of weight 0."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.sampling.distribution import edge_distribution, pmf, sample_edge, stratified

WEIGHTS = [3.0, 0.0, 1.0, 0.5, 0.0, 8.0, 1e-3, 2.5]
COUNT = 1 << 16


def samples(weights, jitter_seed: int, independent: bool):
    dist = edge_distribution(mi.Float(weights))
    rng = mi.PCG32(COUNT, initstate=jitter_seed)
    u = mi.Float64(rng.next_float64()) if independent else stratified(COUNT, rng.next_float32())
    row, t = sample_edge(dist, u)
    return dist, np.array(row), np.array(t)


def chi2_limit(dof: int) -> float:
    """Upper 1e-6 quantile of χ² (Wilson and Hilferty's approximation)."""
    return dof * (1 - 2 / (9 * dof) + 4.753 * np.sqrt(2 / (9 * dof))) ** 3


def test_pmf_is_normalised_and_proportional(variant):
    dist = edge_distribution(mi.Float(WEIGHTS))
    p = np.array(pmf(dist, dr.arange(mi.UInt32, dist.size)))
    assert np.allclose(p, np.array(WEIGHTS) / np.sum(WEIGHTS), rtol=1e-6)


def test_chi2(variant):
    """Independent numbers: rows follow `pmf`, and the remainder t is uniform within each row."""
    dist, row, t = samples(WEIGHTS, 1, independent=True)
    p = np.array(pmf(dist, dr.arange(mi.UInt32, dist.size)), dtype=np.float64)
    observed = np.bincount(row, minlength=len(p))
    assert observed[p == 0].sum() == 0
    expected = COUNT * p[p > 0]
    chi2 = np.sum((observed[p > 0] - expected) ** 2 / expected)
    assert chi2 < chi2_limit((p > 0).sum() - 1)
    for i in np.flatnonzero(expected > 1000):
        bins = np.histogram(t[row == np.flatnonzero(p > 0)[i]], bins=20, range=(0, 1))[0]
        assert np.sum((bins - bins.mean()) ** 2 / bins.mean()) < chi2_limit(19)
    wrong = np.roll(p, 1)[p > 0] + 1e-9  # the test has power: another distribution is far off
    assert np.sum((observed[p > 0] - COUNT * wrong) ** 2 / (COUNT * wrong)) > 100 * chi2_limit(len(wrong))


def test_strata_are_exact(variant):
    """Stratified numbers give every row its share to within two samples, whatever the jitter."""
    for seed in range(3):
        dist, row, t = samples(WEIGHTS, seed, independent=False)
        p = np.array(pmf(dist, dr.arange(mi.UInt32, dist.size)), dtype=np.float64)
        assert np.all(np.abs(np.bincount(row, minlength=len(p)) - COUNT * p) < 2)
        assert np.all((t >= 0) & (t < 1))
        # sample and pmf tie: row and t invert to the number they came from
        below = np.concatenate([[0], np.cumsum(p)])[row]
        u = below + t * p[row]
        assert np.all(np.abs(u * COUNT - np.arange(COUNT) - 0.5) < 0.5 + 1e-2 + 1e-6 * COUNT * p[row])


def test_invalid_weights_count_as_zero(variant):
    dist, row, _ = samples([1.0, float("nan"), -2.0, float("inf"), 3.0], 0, independent=False)
    assert set(row) == {0, 4}
    assert float(dist.total[0]) == pytest.approx(4.0)


def test_one_row_and_none(variant):
    _, row, t = samples([2.0], 0, independent=False)
    assert not row.any() and abs(t.mean() - 0.5) < 1e-3
    assert edge_distribution(mi.Float([0.0, 0.0])).total == 0


def test_a_million_rows_keep_their_resolution(variant):
    """Sums in single precision would give the last rows of a large mesh nothing, or too much."""
    n = 1 << 20
    dist = edge_distribution(dr.full(mi.Float, 0.1, n))
    row, t = sample_edge(dist, stratified(n, dr.full(mi.Float, 0.5, n)))
    assert dr.all(row == dr.arange(mi.UInt32, n))
    assert np.abs(np.array(t) - 0.5).max() < 1e-3
