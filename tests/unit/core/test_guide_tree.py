"""How finely a guide divides: as finely as one half of the samples confirms the other, along whatever helps."""

from __future__ import annotations

import numpy as np
import pytest

from psdr_jit.core.guide_tree import BROAD, FINE, LEAF, grown

MANY, FEW = 400_000, 200


def tables(rng, integrand, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Σw and Σw² of `count` even samples in each half, heavy-tailed: (fine, broad)."""
    found = [np.zeros((2, 2, groups * bins * bins)) for groups, bins in (FINE, BROAD)]
    for half in range(2):
        x, u, v = rng.random((3, count))
        worth = integrand(x, u, v) * rng.exponential(size=count)
        for table, (groups, bins) in zip(found, (FINE, BROAD), strict=True):
            cell = ((x * groups).astype(int) * bins + (u * bins).astype(int)) * bins + (v * bins).astype(int)
            for power in (1, 2):
                table[power - 1, half] = np.bincount(cell, worth**power, groups * bins * bins)
    return tuple(t.reshape(2, 2, g, b, b) for t, (g, b) in zip(found, (FINE, BROAD), strict=True))


def second_moment(tree, integrand, rng, count: int = 200_000) -> float:
    """∫ f²/p over ∫ f² with the density p of the tree, by even samples; also checks that p integrates to 1."""
    place = rng.random((3, count))
    first = np.where(tree.axis != LEAF, 2 * np.cumsum(tree.axis != LEAF) - 1, 0)
    node, p = np.zeros(count, int), np.ones(count)
    at = place.copy()
    while (tree.axis[node] != LEAF).any():
        axis = tree.axis[node]
        inner = axis != LEAF
        value = at[np.minimum(axis, 2), np.arange(count)]
        upper = inner & (value >= 0.5)
        p *= np.where(inner, 2 * np.where(upper, 1 - tree.lower[node], tree.lower[node]), 1)
        at[np.minimum(axis, 2), np.arange(count)] = np.where(inner, 2 * value - upper, value)
        node = np.where(inner, first[node] + upper, node)
    assert np.mean(p) == pytest.approx(1, rel=0.05)
    f2 = integrand(*place)
    return float(np.mean(f2 / p) / np.mean(f2))


def stripes(x, u, v):
    """Fine along the edges, the same in all directions."""
    return np.where((500 * x) % 1 < 0.2, 1.0, 1e-3)


def cone(x, u, v):
    """A small range of directions, the same on all edges."""
    return np.where((np.abs(u - 0.4) < 0.05) & (np.abs(v - 0.7) < 0.05), 1.0, 1e-3)


def both(x, u, v):
    """A direction that changes along the edges."""
    return np.where(np.abs(u - x) < 0.08, 1.0, 1e-3)


@pytest.mark.parametrize("integrand, most", [(stripes, 0.45), (cone, 0.25), (both, 0.35)])
def test_it_finds_what_is_fine_and_what_is_broad(integrand, most):
    rng = np.random.default_rng(1)
    tree = grown(*tables(rng, integrand, MANY))
    left = second_moment(tree, integrand, rng)
    assert left < most
    assert tree.left == pytest.approx(left, rel=0.25)


def test_only_what_helps_is_divided():
    rng = np.random.default_rng(2)
    axes = np.bincount(grown(*tables(rng, stripes, MANY)).axis, minlength=4)
    assert axes[0] > 500 and axes[1] + axes[2] < 0.5 * axes[0]
    axes = np.bincount(grown(*tables(rng, cone, MANY)).axis, minlength=4)
    assert axes[0] < 0.3 * (axes[1] + axes[2])


def test_what_is_even_is_left_alone():
    rng = np.random.default_rng(3)
    tree = grown(*tables(rng, lambda x, u, v: np.ones_like(x), MANY))
    assert tree.left > 0.97
    assert 0.98 < second_moment(tree, lambda x, u, v: np.ones_like(x), rng) < 1.02


def test_halves_that_contradict_each_other_divide_nothing():
    rng = np.random.default_rng(4)
    fine, broad = tables(rng, cone, MANY)
    elsewhere = tables(rng, lambda x, u, v: cone(x, 1 - u, v), MANY)
    fine[:, 1], broad[:, 1] = (table[:, 1] for table in elsewhere)
    assert grown(fine, broad).left > 0.6
    nothing = np.zeros_like(fine), np.zeros_like(broad)
    assert len(grown(*nothing).axis) == 1 and grown(*nothing).left == 1


def test_few_samples_are_not_believed():
    """Two hundred heavy-tailed samples do not tell where fine stripes are: the guide must not be worse than none."""
    rng = np.random.default_rng(5)
    left = [second_moment(grown(*tables(rng, stripes, FEW)), stripes, rng) for _ in range(5)]
    assert np.median(left) < 1.25
    assert max(left) < 1.6
