"""The guide over random numbers of lines: a density, unbiased, and none where one half of the pilot contradicts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.line_guide import BINS, EVEN_SHARES, GROUPS, NO_CELL, SHAPE, LineGuide, LineTally, evenly

COUNT = 2_000_000


def spot() -> np.ndarray:
    """Integrals of f² of something that is seen in few cells."""
    moments = np.zeros(SHAPE)
    moments[3, 2:4, 5] = 1.0
    return moments


def cube() -> tuple[mi.Float64, mi.Point2f]:
    """Random points of the unit cube."""
    x, u, v = np.random.default_rng(1).random((3, COUNT))
    return mi.Float64(x), mi.Point2f(u.astype(np.float32), v.astype(np.float32))


@pytest.mark.parametrize("even", EVEN_SHARES)
def test_integrals_are_the_same(llvm, even):
    """∫ g over the cube from guided numbers, g/p: a wrong density would show at once."""
    guide = LineGuide.of(spot(), even)
    x, u, drawn = guide.tables().draw(*cube())
    g = mi.Float(x) ** 2 + u.x * (1 - u.y)
    assert float(dr.mean(g / drawn.p)[0]) == pytest.approx(1 / 3 + 1 / 4, rel=5e-3)
    assert float(dr.mean(dr.rcp(drawn.p))[0]) == pytest.approx(1, rel=5e-3)
    assert float(dr.min(drawn.p)[0]) > 0.8 * even


def test_lines_go_where_something_was_found(llvm):
    guide = LineGuide.of(spot(), 0.2)
    x, u, drawn = guide.tables().draw(*cube())
    dr.eval(x, u, drawn)
    assert (np.array(drawn.cell) == np.array(evenly(x, u).cell)).mean() > 0.9999  # but for rounding at their borders
    inside = np.isin(np.array(drawn.cell), [(3 * BINS + i) * BINS + 5 for i in (2, 3)])
    assert inside.mean() > 30 * 2 / (GROUPS * BINS * BINS)
    for numbers in (x, u.x, u.y):
        assert 0 <= float(dr.min(numbers)[0]) and float(dr.max(numbers)[0]) < 1


def test_a_tally_estimates_second_moments(llvm):
    """c = f/p with p of the guide: Σ c² p is the integral of f², however the lines were drawn."""
    found = []
    for guide in (None, LineGuide.of(spot(), 0.5)):
        x, u = cube()
        drawn = evenly(x, u)
        if guide is not None:
            x, u, drawn = guide.tables().draw(x, u)
        f = mi.Float(x) + u.x
        tally = LineTally()
        tally.add(drawn, dr.arange(mi.UInt32, dr.width(f)), f / drawn.p)
        found.append(tally.moments)
    assert np.allclose(*found, rtol=0.3)
    assert found[0].shape == SHAPE and found[0].min() > 0


def test_lines_drawn_otherwise_are_not_counted(llvm):
    drawn = evenly(mi.Float64(0.5), mi.Point2f(0.5))
    drawn.cell = mi.UInt32(NO_CELL)
    tally = LineTally()
    tally.add(drawn, mi.UInt32(0), mi.Float(3))
    assert not tally.moments.any()


def test_halves_that_contradict_each_other_make_no_guide():
    elsewhere = np.roll(spot(), 7, axis=0)
    assert LineGuide.between(spot(), elsewhere, 0.1) == (None, 1.0)
    assert LineGuide.between(np.zeros(SHAPE), spot(), 0.1) == (None, 1.0)
    guide, gain = LineGuide.between(spot(), 2 * spot(), 0.1)
    assert gain > 5 and guide.density[3, 2, 5] > 100
