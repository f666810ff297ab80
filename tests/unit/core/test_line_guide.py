"""The guide over random numbers of lines: a density, unbiased, and none where halves of what was heard contradict."""

from __future__ import annotations

import base64
import zlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.line_guide import EVEN_SHARE, Drawn, LineGuide, LineTally, evenly

COUNT = 2_000_000


def even(seed: int = 1) -> tuple[mi.Float64, mi.Point2f]:
    """Random points of the unit cube."""
    x, u, v = np.random.default_rng(seed).random((3, COUNT))
    return mi.Float64(x), mi.Point2f(u.astype(np.float32), v.astype(np.float32))


def spot(x: mi.Float, u: mi.Point2f) -> mi.Float:
    """Something that is seen in few directions from one part of the edges."""
    inside = (dr.abs(x - 0.2) < 0.03) & (dr.abs(u.x - 0.3) < 0.1) & (u.y > 0.6)
    return dr.select(inside, 1 + u.y, 1e-3)


def heard(guide: LineGuide | None = None, f=spot) -> LineTally:
    """What lines tell that are drawn by a guide, or evenly."""
    x, u = even()
    drawn = evenly(x, u)
    if guide is not None:
        _, _, drawn = guide.tables().draw(x, u)
    tally = LineTally()
    tally.add(drawn, dr.arange(mi.UInt32, COUNT), f(drawn.x, drawn.u) / drawn.p, 3)
    return tally


def test_integrals_are_the_same(llvm):
    """∫ g over the cube from guided numbers, g/p: a wrong density would show at once."""
    guide, gain = heard().guide()
    assert gain > 5
    x, u, drawn = guide.tables().draw(*even(2))
    g = mi.Float(x) ** 2 + u.x * (1 - u.y)
    assert float(dr.mean(g / drawn.p)[0]) == pytest.approx(1 / 3 + 1 / 4, rel=5e-3)
    assert float(dr.mean(dr.rcp(drawn.p))[0]) == pytest.approx(1, rel=5e-3)
    assert float(dr.min(drawn.p)[0]) > 0.8 * EVEN_SHARE


def test_lines_go_where_something_was_found(llvm):
    guide, gain = heard().guide()
    x, u, drawn = guide.tables().draw(*even(2))
    assert float(dr.mean(dr.select(spot(drawn.x, drawn.u) > 0.5, mi.Float(1), 0))[0]) > 0.25  # of 0.0048 of the cube
    for numbers in (x, u.x, u.y):
        assert 0 <= float(dr.min(numbers)[0]) and float(dr.max(numbers)[0]) < 1
    f = spot(drawn.x, drawn.u)
    x, u = even(2)
    before = float(dr.mean(dr.square(spot(mi.Float(x), u)))[0])
    assert before / float(dr.mean(dr.square(f / drawn.p))[0]) == pytest.approx(gain, rel=0.3)


def test_lanes_stay_sorted_along_the_edges(llvm):
    guide, _ = heard().guide()
    x, _, _ = guide.tables().draw(mi.Float64(np.sort(np.random.default_rng(3).random(COUNT))), even()[1])
    assert (np.diff(np.array(x)) >= -1e-7).all()


def test_a_tally_estimates_the_same_however_lines_were_drawn(llvm):
    guide, _ = heard().guide()
    of_even, of_guided = (heard(g).sums() for g in (None, guide))
    for a, b in zip(of_even, of_guided, strict=True):
        a, b = a[0], b[0]
        assert a.sum() == pytest.approx(b.sum(), rel=0.05)
        assert a.shape == b.shape and (a.reshape(2, -1).sum(1) > 0.4 * a.sum()).all()
        assert np.allclose(a.sum((0, 1)), b.sum((0, 1)), rtol=0.2, atol=0.02 * a.sum((0, 1)).max())  # by direction


def test_passes_of_more_samples_tell_more(llvm):
    """c is f over the number of samples: N of them, each times N, tell N times as much as one."""
    x, u = even()
    drawn, lane = evenly(x, u), dr.arange(mi.UInt32, COUNT)
    sums = []
    for spp in (1, 4):
        tally = LineTally()
        tally.add(drawn, lane, spot(drawn.x, drawn.u) / spp, spp)
        sums.append(tally.sums()[0][0].sum())
    assert sums[0] == pytest.approx(sums[1], rel=1e-3)


def test_lines_drawn_otherwise_are_not_counted(llvm):
    tally = LineTally()
    tally.add(Drawn.otherwise(), mi.UInt32(0), mi.Float(3), 1)
    assert not tally.sums()[0].any()


def test_what_was_heard_fades(llvm):
    tally = heard()
    before = tally.sums()[1][0].sum()
    tally.fade(0.25)
    assert tally.sums()[1][0].sum() == pytest.approx(0.25 * before)


def test_nothing_heard_and_nothing_particular_make_a_guide_without_preferences(llvm):
    for tally in (LineTally(), heard(f=lambda x, u: 1 + 0.2 * x)):
        guide, gain = tally.guide()
        assert not guide.prefers and gain == 1
        x, u = even()
        guided_x, guided_u, drawn = guide.tables().draw(x, u)
        assert dr.allclose(guided_x, x) and dr.allclose(guided_u, u) and dr.all(drawn.p == 1)


@pytest.mark.parametrize("axis, steps", [([0, 3], [9, 9]), ([0, 3, 4], [9, 9, 9]), ([0, 3, 3], [0, 9, 9]), ([], [])])
def test_a_text_that_is_no_tree_is_refused(axis, steps):
    text = base64.b64encode(zlib.compress(bytes(axis + steps))).decode()
    with pytest.raises(ValueError):
        LineGuide(text).require_tree()
