"""Where lines through edges are worth sampling: a guide over the random numbers that choose them.

A line is drawn by three numbers in [0, 1): x picks the edge and the place on it, u the direction (`edges/wedges.py`,
`sampling/directions.py`). Whatever these mean, the term is ∫ f(x, u) dx du over the unit cube, f the contribution over
the line's density. Most lines bring nothing: they end where no light comes from, or where the sensor does not look.
So the cube is divided into cells, the numbers are drawn with a density p that is constant in each of them, and f is
divided by p. The least variance has p ∝ √E[f²] in every cell, which the pilot's samples tell: Σ c² p, c = f/p their
contributions, estimates the integral of f² over a cell. A share of the lines is spread evenly: p is never 0, and
weights are bounded. How large it is, and whether there is a guide at all, is for one half of the pilot to say of a
guide made from the other: a few large contributions tell little about where the next ones are.

The map from even numbers to guided ones is monotonous in each of them, so that stratification carries over.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from .levels import packed, unpacked
from .upload import uploaded

#: Cells: of the edges, in the order of their rows, and of either random number of the direction.
GROUPS, BINS = 16, 8
SHAPE = (GROUPS, BINS, BINS)

#: Shares of the lines that may be spread evenly.
EVEN_SHARES = (0.2, 0.5)

#: Factor between second moments from which a guide is worth having.
LEAST_GAIN = 1.5


@dataclass
class Drawn:
    """How a line was drawn. Detached."""

    cell: mi.UInt32  # NO_CELL: in another way
    p: mi.Float  # density in the unit cube


#: Number of no cell.
NO_CELL = GROUPS * BINS * BINS


class LineTally:
    """What lines of each cell have brought to the film. Host object with a device table."""

    def __init__(self):
        self._moments = dr.zeros(mi.Float, NO_CELL + 1)
        dr.make_opaque(self._moments)

    def add(self, drawn: Drawn, lane: mi.UInt32, contribution: mi.Float) -> None:
        """Contributions to the film, each of line `lane`."""
        of = dr.gather(Drawn, drawn, lane)
        worth = dr.square(contribution) * of.p
        dr.scatter_add(self._moments, worth, of.cell, dr.isfinite(worth) & (worth > 0))

    @property
    def moments(self) -> np.ndarray:
        """Relative integrals of f², `SHAPE`."""
        return np.array(self._moments, np.float64)[:NO_CELL].reshape(SHAPE)


@dataclass(frozen=True)
class LineGuide:
    """Density of lines in the unit cube, by cell. Host object, plain text."""

    levels: str

    @staticmethod
    def of(moments: np.ndarray, even: float) -> LineGuide | None:
        """From the integrals of f² in each cell, with a share of `even` lines; None if they are 0."""
        root = np.sqrt(_smoothed(moments))
        return LineGuide(packed(even + (1 - even) * root / root.mean())) if root.mean() > 0 else None

    @staticmethod
    def between(few: np.ndarray, more: np.ndarray, weight: float) -> tuple[LineGuide | None, float]:
        """`(guide, gain)` from two halves of a pilot, `few` to be weighed by `weight`; None: none is worth it."""

        def told(even: float) -> float:
            guides = LineGuide.of(few, even), LineGuide.of(more, even)
            if None in guides:
                return 1.0
            return float(np.sqrt(guides[0].gain(more) * guides[1].gain(few)))

        gain, even = max((told(even), even) for even in EVEN_SHARES)
        if gain < LEAST_GAIN:
            return None, 1.0
        return LineGuide.of(weight * few + more, even), gain

    @cached_property
    def density(self) -> np.ndarray:
        """`SHAPE`, mean 1."""
        return unpacked(self.levels, SHAPE)

    def gain(self, moments: np.ndarray) -> float:
        """By which factor the second moment falls if integrals of f² are `moments`."""
        guided = float((moments / self.density).sum())
        return float(moments.sum()) / guided if guided > 0 else 1.0

    def tables(self) -> GuideTables:
        """The same on the device."""
        cells = self.density
        bins, groups = cells.sum(2), cells.sum((1, 2))
        return GuideTables(*(
            uploaded(mi.Float, (np.cumsum(w, -1) / w.sum(-1, keepdims=True)).ravel()) for w in (groups, bins, cells)
        ))  # fmt: skip


def _smoothed(moments: np.ndarray) -> np.ndarray:
    """A little of every neighbour's in the square of directions, which wraps around in neither number."""
    padded = np.pad(moments, ((0, 0), (1, 1), (1, 1)), mode="edge")
    near = sum(np.roll(padded, shift, axis)[:, 1:-1, 1:-1] for shift in (-1, 1) for axis in (1, 2))
    return (4 * moments + near) / 8


@dataclass
class GuideTables:
    """Cumulative probabilities: of groups, of bins of the first number by group, of the second by both. Detached."""

    groups: mi.Float
    first: mi.Float
    second: mi.Float

    def draw(self, x: mi.Float64, u: mi.Point2f) -> tuple[mi.Float64, mi.Point2f, Drawn]:
        """Guided numbers for even ones, and how they were drawn."""
        group, x, p_x = _inverted(self.groups, mi.UInt32(0), GROUPS, x)
        i, u_x, p_i = _inverted(self.first, group * BINS, BINS, u.x)
        row = group * BINS + i
        j, u_y, p_j = _inverted(self.second, row * BINS, BINS, u.y)
        return x, mi.Point2f(u_x, u_y), Drawn(row * BINS + j, mi.Float(p_x) * p_i * p_j)


def _inverted(cumulative: mi.Float, start: mi.UInt32, n: int, u):
    """`(bin, number in [0, 1), density)` of the piecewise constant density with n bins from `start`."""
    kind = type(u)
    found = mi.UInt32(0)
    for i in range(n - 1):
        found += dr.select(u >= kind(dr.gather(mi.Float, cumulative, start + i)), mi.UInt32(1), 0)
    upper = kind(dr.gather(mi.Float, cumulative, start + found))
    lower = dr.select(found > 0, kind(dr.gather(mi.Float, cumulative, start + found - 1, found > 0)), 0)
    place = dr.clip((u - lower) / (upper - lower), 0, dr.one_minus_epsilon(mi.Float))
    return found, dr.minimum((kind(found) + place) / n, dr.one_minus_epsilon(mi.Float)), (upper - lower) * n


def evenly(x: mi.Float64, u: mi.Point2f) -> Drawn:
    """How numbers are drawn without a guide."""
    i, j = (mi.UInt32(v * BINS) for v in (u.x, u.y))
    return Drawn((mi.UInt32(x * GROUPS) * BINS + i) * BINS + j, mi.Float(1))
