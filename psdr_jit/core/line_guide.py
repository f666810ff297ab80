"""Where lines through edges are worth sampling: a guide over the random numbers that choose them.

A line is drawn by three numbers in [0, 1): x picks the edge and the place on it, u the direction (`edges/wedges.py`,
`sampling/directions.py`). Whatever these mean, the term is ∫ f(x, u) dx du over the unit cube, f the contribution over
the line's density. Most lines bring nothing: they end where no light comes from, or where the sensor does not look.
So the cube is divided into boxes, the numbers are drawn with a density p that is constant in each of them, and f is
divided by p. The least variance has p ∝ √E[f²] in every box, which samples tell: Σ c² p, c = f/p their contributions,
estimates the integral of f² over a box, whatever guide they were drawn by. How finely it is worth to divide, and
whether at all, one half of the samples tells of the other (`guide_tree.py`). A share of the lines is spread evenly: p
is never 0, and weights are bounded.

The map from even numbers to guided ones halves box by box. It is monotonous in x, whatever the direction: lanes that
are sorted along the edges stay so, and stratification carries over.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from .guide_tree import BROAD, FINE, LEAF, UNDIVIDED, Tree, grown
from .upload import uploaded
from .varying import varying

#: Share of the lines that is spread evenly: no weight is larger than 1 over it.
EVEN_SHARE = 0.2

#: Factor between second moments from which a guide is worth having.
LEAST_GAIN = 1.3

#: Steps of a probability in a guide's text.
STEPS = 254


@dataclass
class Drawn:
    """How a line was drawn. Detached."""

    x: mi.Float  # its numbers; x < 0: in another way
    u: mi.Point2f
    p: mi.Float  # density in the unit cube

    @staticmethod
    def otherwise() -> Drawn:
        """Not by a guide's numbers."""
        return Drawn(mi.Float(-1), mi.Point2f(0), mi.Float(1))


class LineTally:
    """What lines of each cell have brought to the film, in two independent halves. Host object with device tables."""

    #: Cells of a half: of x and of either number of the direction.
    SHAPES = ((FINE[0], FINE[1], FINE[1]), (BROAD[0], BROAD[1], BROAD[1]))

    def __init__(self):
        self._tables = [dr.zeros(mi.Float, 4 * int(np.prod(shape))) for shape in self.SHAPES]
        dr.make_opaque(self._tables)

    def add(self, drawn: Drawn, lane: mi.UInt32, contribution: mi.Float, spp: int) -> None:
        """Contributions to the film, each of line `lane`, of a pass of `spp` samples per pixel."""
        of = dr.gather(Drawn, drawn, lane)
        worth = dr.square(contribution * varying(mi.Float, spp)) * of.p
        active = dr.isfinite(worth) & (worth > 0) & (of.x >= 0)
        for table, (groups, bins, _) in zip(self._tables, self.SHAPES, strict=True):
            i, j, k = (dr.minimum(mi.UInt32(v * n), n - 1) for v, n in ((of.x, groups), (of.u.x, bins), (of.u.y, bins)))
            cell = (((lane & 1) * groups + i) * bins + j) * bins + k
            dr.scatter_add(table, worth, cell, active)
            dr.scatter_add(table, dr.square(worth), cell + 2 * groups * bins * bins, active)
        dr.schedule(self._tables)

    def sums(self) -> tuple[np.ndarray, np.ndarray]:
        """Of w = c² p and of w², by half and cell, (2, 2, *shape) for each of `SHAPES`. Waits for them.

        Those of w are relative integrals of f².
        """
        return tuple(
            np.array(table, np.float64).reshape(2, 2, *shape)
            for table, shape in zip(self._tables, self.SHAPES, strict=True)
        )

    def fade(self, share: float) -> None:
        """Let what was heard up to now count for `share` of itself: the scene may change."""
        # on the host, where no kernel has to be compiled for it; Σw² as well: n fades, too
        self._tables = [uploaded(mi.Float, share * table.ravel()) for table in self.sums()]

    def guide(self, least_gain: float = LEAST_GAIN) -> tuple[LineGuide, float]:
        """`(guide, gain)` as far as the halves confirm each other, the gain of second moments; where that is less than
        `least_gain`, a guide without preferences: later ones, which may have some, need no other kernels.
        """
        tree = grown(*self.sums())
        gain = (1 - EVEN_SHARE) / tree.left
        return (LineGuide.of(tree), gain) if gain >= least_gain else (NO_PREFERENCE, 1.0)


@dataclass(frozen=True)
class LineGuide:
    """Density of lines in the unit cube, constant in boxes. Host object, plain text."""

    nodes: str  # of the tree: the axis of each node, and the probability of its lower part

    @staticmethod
    def of(tree: Tree) -> LineGuide:
        """The density of a tree, and `EVEN_SHARE` of the lines spread evenly."""
        steps = np.clip(np.round(_with_even_share(tree) * STEPS), 1, STEPS - 1).astype(np.uint8)
        return LineGuide(base64.b64encode(zlib.compress(tree.axis.tobytes() + steps.tobytes())).decode())

    @property
    def prefers(self) -> bool:
        """Are lines not spread evenly?"""
        return len(self.tree.axis) > 1

    @cached_property
    def tree(self) -> Tree:
        """Its nodes. Raises ValueError or zlib.error for a text that is none."""
        axis, steps = np.frombuffer(zlib.decompress(base64.b64decode(self.nodes)), np.uint8).reshape(2, -1)
        divided = int((axis != LEAF).sum())
        if axis.max(initial=0) > LEAF or 2 * divided + 1 != len(axis) or not ((steps > 0) & (steps < STEPS)).all():
            raise ValueError("its guide is no tree")
        return Tree(axis, steps / STEPS, 1.0)

    def require_tree(self) -> None:
        """Raises ValueError or zlib.error unless the text is that of a tree."""
        _ = self.tree

    @property
    def key(self) -> int:
        """A number of its own, for random numbers of its own."""
        return zlib.crc32(self.nodes.encode())

    def tables(self) -> GuideTables:
        """The same on the device."""
        tree = self.tree
        first = np.where(tree.axis != LEAF, 2 * np.cumsum(tree.axis != LEAF) - 1, 0)
        # one node more than there is: of arrays with a single entry Dr.Jit would make other kernels
        axis, first, lower = (np.append(column, column[-1]) for column in (tree.axis, first, tree.lower))
        return GuideTables(uploaded(mi.UInt32, axis), uploaded(mi.UInt32, first), uploaded(mi.Float, lower))


def _with_even_share(tree: Tree) -> np.ndarray:
    """Probability of the lower part of every node if `EVEN_SHARE` of the lines are spread evenly over the cube."""
    inner = np.flatnonzero(tree.axis != LEAF)
    mass, volume = np.ones(len(tree.axis)), np.ones(len(tree.axis))
    for number, node in enumerate(inner):  # parts come after what they are parts of
        a, b = 2 * number + 1, 2 * number + 2
        mass[a], mass[b] = mass[node] * tree.lower[node], mass[node] * (1 - tree.lower[node])
        volume[a] = volume[b] = volume[node] / 2
    mixed = EVEN_SHARE * volume + (1 - EVEN_SHARE) * mass
    lower = np.full(len(tree.axis), 0.5)
    lower[inner] = mixed[2 * np.arange(len(inner)) + 1] / mixed[inner]
    return lower


NO_PREFERENCE = LineGuide.of(UNDIVIDED)


@dataclass
class GuideTables:
    """The nodes of a guide's tree. Detached."""

    axis: mi.UInt32
    first: mi.UInt32  # the lower part; the upper one is the next
    lower: mi.Float  # its probability

    @dr.syntax
    def draw(self, x: mi.Float64, u: mi.Point2f) -> tuple[mi.Float64, mi.Point2f, Drawn]:
        """Guided numbers for even ones, and how they were drawn."""
        x, v, w = mi.Float64(x), mi.Float(u.x), mi.Float(u.y)  # in the box
        start_x, start_v, start_w = mi.Float64(0), mi.Float(0), mi.Float(0)  # of the box
        size_x, size_v, size_w = mi.Float64(1), mi.Float(1), mi.Float(1)
        p = mi.Float(1)
        node = dr.zeros(mi.UInt32, dr.width(x))
        axis = dr.gather(mi.UInt32, self.axis, node)
        while dr.hint(axis != LEAF, label="psdr.guide", exclude=[self]):
            share = dr.gather(mi.Float, self.lower, node)
            x, start_x, size_x, in_x = _halved(x, start_x, size_x, share, axis == 0)
            v, start_v, size_v, in_v = _halved(v, start_v, size_v, share, axis == 1)
            w, start_w, size_w, in_w = _halved(w, start_w, size_w, share, axis == 2)
            upper = in_x | in_v | in_w
            p *= 2 * dr.select(upper, 1 - share, share)
            node = dr.gather(mi.UInt32, self.first, node) + dr.select(upper, mi.UInt32(1), 0)
            axis = dr.gather(mi.UInt32, self.axis, node)
        x, v, w = start_x + x * size_x, start_v + v * size_v, start_w + w * size_w
        u = mi.Point2f(v, w)
        return x, u, Drawn(mi.Float(x), u, p)


def _halved(value, start, size, lower: mi.Float, active: mi.Bool):
    """`(number, start, size, upper)` of the half of a box that an even number in [0, 1) falls into, where active."""
    kind = type(value)
    q = kind(lower)
    upper = active & (value >= q)
    inside = dr.select(upper, (value - q) / (1 - q), value / q)
    value = dr.select(active, dr.clip(inside, 0, dr.one_minus_epsilon(mi.Float)), value)
    size = dr.select(active, size / 2, size)
    return value, dr.select(upper, start + size, start), size, upper


def evenly(x: mi.Float64, u: mi.Point2f) -> Drawn:
    """How numbers are drawn without a guide."""
    return Drawn(mi.Float(x), mi.Point2f(u), mi.Float(1))
