"""The search for crossings on lines of which it is known where they cross what."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.chain_search import find_crossings
from psdr_jit.boundary.chain_trace import Pair

LINES = 40_000

#: Of awkward lines: where a step that cannot move lies, and how far apart chains are taken to differ.
AT_REST, FAR = 0.37, 0.21

#: Of a fence: twice as many crossings.
STRIPES = 5


class Striped:
    """Lines across one stripe each, from `start` to `start + width`. The family keeps guesses out.

    Awkward ones are taken to differ where they are far apart, and see a step that rests.
    """

    narrowest, first_kept, analytic, copies = 2.0**-10, 0, None, None

    def __init__(self, start: np.ndarray, width: float, lamp: bool, awkward: bool):
        self.count, self.start, self.width = len(start), mi.Float(start.astype(np.float32)), width
        self.lamp, self.awkward = lamp, awkward
        self.job = SimpleNamespace(seed=7, surfaces=None, facts=SimpleNamespace(shapes=()))

    least_width = property(lambda self: mi.Float(2.0**-12))

    def tell_effort(self, sample: mi.UInt32, segments: mi.UInt32) -> None:
        """Nobody asks."""

    def compare(self, sample: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> Pair:
        start = dr.gather(mi.Float, self.start, sample)
        inside = [(s > start) & (s < start + self.width) for s in ends]
        pair = Pair.start()
        pair.differs, pair.specular, pair.moves = inside[0] != inside[1], mi.Bool(True), mi.Bool(True)
        pair.family = mi.UInt32(0)
        if self.awkward:
            pair.moves = pair.differs | (dr.abs(ends[1] - ends[0]) > FAR)
            pair.differs = pair.moves | ((ends[0] < AT_REST) & (ends[1] > AT_REST))
        if self.lamp:
            pair.lamp = (start + 0.5 * self.width - ends[0]) / (ends[1] - ends[0])
            pair.miss = dr.select((pair.lamp > 0) & (pair.lamp < 1), mi.Float(0), dr.inf)
        return pair


def _found(width: float, lamp: bool = False, awkward: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Weights (LINES, 2) with which the edges of a stripe somewhere on a line are found; and errors of their place."""
    start = np.random.default_rng(3).uniform(0, 1 - width, LINES).astype(np.float32)
    found = find_crossings(Striped(start, width, lamp, awkward)).at
    sample, lo, hi = (np.array(v) for v in (found.sample, found.lo, found.hi))
    edges = np.stack((start, start + np.float32(width)), 1)[sample]
    off = np.abs(edges - ((lo + hi) / 2)[:, None])
    weights = np.zeros((LINES, 2))
    np.add.at(weights, (sample, off.argmin(1)), np.array(found.weight))
    return weights, off.min(1)


@pytest.mark.parametrize("awkward", [False, True])
@pytest.mark.parametrize("width", [0.3, 0.05, 0.01])
def test_every_crossing_is_found_with_weight_one_on_average(width, awkward, llvm):
    weights, off = _found(width, awkward=awkward)
    mean, error = weights.mean(0), weights.std(0) / LINES**0.5
    assert off.max() < 2.0**-11
    assert np.abs(mean - 1).max() < 4 * error.max() < 0.35


@pytest.mark.parametrize("width", [0.3, 0.05, 0.01])
def test_both_edges_of_what_is_thin_are_found_together(width, llvm):
    weights, _ = _found(width)
    some = weights.sum(1) > 0
    assert np.mean(weights[some, 0] == weights[some, 1]) > 0.95
    assert weights.max() < 8 / (0.3 * width)


def test_a_lamp_is_found_without_weight(llvm):
    weights, _ = _found(0.01, lamp=True)
    assert np.mean(weights[:, 0] == 1) > 0.8
    assert abs(weights[:, 0].mean() - 1) < 4 * weights[:, 0].std() / LINES**0.5
    assert np.mean(weights[:, 0] == weights[:, 1]) > 0.99


class Fence(Striped):
    """Lines across `STRIPES` wide stripes."""

    def compare(self, sample: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> Pair:
        pair = super().compare(sample, ends)
        start = dr.gather(mi.Float, self.start, sample)
        number = [mi.Int32(dr.floor(2 * STRIPES * s + start)) for s in ends]
        pair.differs = (number[0] & 1) != (number[1] & 1)
        return pair


@pytest.mark.parametrize("lines", [LINES, 300])
def test_more_crossings_are_found_than_a_search_has_room_for(lines, llvm):
    """Lanes take up search after search, and what is left of those that pause."""
    start = np.random.default_rng(4).uniform(0.1, 0.9, lines)
    found = find_crossings(Fence(start, 0.0, lamp=False, awkward=False)).at
    sample, lo, weight = (np.array(v) for v in (found.sample, found.lo, found.weight))
    number = np.rint(2 * STRIPES * lo + start[sample]).astype(int)
    assert np.abs(2 * STRIPES * lo + start[sample] - number).max() < 0.01
    weights = np.zeros((lines, 2 * STRIPES + 1))
    np.add.at(weights, (sample, number), weight)
    mean, error = weights[:, 1:].mean(0), weights[:, 1:].std(0) / lines**0.5
    assert (weights[:, 1:] > 0).sum(1).max() > 8 and weights[:, 0].max() == 0
    assert np.all(np.abs(mean - 1) < 5 * error)


def test_a_search_that_is_alone_is_not_made_twice(llvm):
    """Kernels for single lanes would be others: it has one beside it that has ended."""
    for seed in range(60):
        start = np.array([0.2 + 0.005 * seed])
        lines = Striped(start, 0.3, lamp=False, awkward=False)
        lines.job.seed = seed
        found = find_crossings(lines)
        if found is not None:
            lo = np.sort(np.array(found.at.lo))
            assert np.all(np.diff(lo) > 0.2), f"seed {seed}: {lo}"


class Unlike(Striped):
    """Lines that end on a surface that is like nothing, itself included, as one whose normals are not numbers."""

    def compare(self, sample: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> Pair:
        pair = super().compare(sample, ends)
        last = 1 - 2 * self.least_width
        pair.differs |= (ends[0] >= last) | (ends[1] >= last)
        return pair


def test_a_search_ends_where_nothing_is_alike(llvm):
    """It went on for ever behind the last crossing, on a part of the line that has no width."""
    start = np.linspace(0.1, 0.8, 50)
    found = find_crossings(Unlike(start, 0.1, lamp=False, awkward=False)).at
    lo, width = np.array(found.lo), np.array(found.hi - found.lo)
    assert len(np.unique(np.array(found.sample)[lo > 0.95])) == len(start)
    assert width.max() <= 2.0**-12
