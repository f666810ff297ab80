"""How fine may a guide be? A tree of halved boxes in the unit cube, grown from moments that were seen. Pure NumPy.

The cube of `line_guide` is divided by halving: first along x, the place among all edges, then, inside of one interval
of x, along the two numbers u, v of the direction. A node draws its lower half with the probability that is best for
what is known of both, q ∝ √(m ρ), m the integral of f² over a half and ρ ≤ 1 the share of its second moment that is
left if the half is divided further.

Finer is better only as long as the moments are known: rare large contributions tell little about where the next ones
are. So q is drawn towards an even 1/2 by as much as `DOUBT` samples would, against the effective number n = m² / Σw²
of those in the node, w = c² p what each of them tells [Kish 1965]. And two independent halves of the samples tell,
each from the probabilities that the other one would have chosen,

    ρ_h = (m_h1 ρ_h1 / q_1 + m_h2 ρ_h2 / q_2) / (m_h1 + m_h2),        q_1 + q_2 = 2,        h = 0, 1

so that a node is divided only if the geometric mean of both says that it pays. Costs are settled from the finest boxes
upwards, as most divisions pay only by what lies below them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Cells of x, and of either number of the direction, where x is known well and where the direction is.
FINE, BROAD = (4096, 4), (256, 16)

#: Least share of a node's samples that either half gets, in units of an even half.
LEAST_HALF = 0.1

#: Samples as which the belief counts that both halves of a node are alike.
DOUBT = 4.0

#: A division has to leave less than this share of a node's second moment.
WORTHWHILE = 0.97

#: Axis of a node that is not divided.
LEAF = 3


@dataclass(frozen=True)
class Tree:
    """Nodes in breadth-first order; the two parts of the i-th node that is divided are the nodes 2i + 1 and 2i + 2."""

    axis: np.ndarray  # (N,) uint8: 0, 1, 2 for x, u, v; `LEAF`
    lower: np.ndarray  # (N,) float: probability of the lower part; 1/2 at leaves
    left: float  # share of the second moment that is left, as either half of the samples tells of the other


UNDIVIDED = Tree(np.array([LEAF], np.uint8), np.array([0.5]), 1.0)


@dataclass(frozen=True)
class _Nodes:
    """Boxes of one size, (2, ...) by half of the samples: their moments, and the share that is left of each."""

    m: np.ndarray
    squares: np.ndarray  # Σw²
    rho: np.ndarray


@dataclass(frozen=True)
class _Step:
    """Nodes of one size, and how each is divided."""

    nodes: _Nodes
    axis: int
    divided: np.ndarray | None  # by node; None: there is nothing finer
    lower: np.ndarray | None  # probability of the lower part


def grown(fine: np.ndarray, broad: np.ndarray) -> Tree:
    """The tree for Σw and Σw² of two halves of the samples, (2, 2, X, U, V), in cells of `FINE` and of `BROAD`."""
    levels, planes = [], []
    here = None
    for k in range(_finest(broad), -1, -1):
        below = here
        plane = _planes(_at(k, fine, broad))
        top = plane[-1].nodes
        here, divided, lower = _Nodes(*(a.reshape(2, -1) for a in (top.m, top.squares, top.rho))), None, None
        if below is not None:
            split, lower = _merged(_part(below, 0, 1), _part(below, 1, 1))
            divided = _left(split) < WORTHWHILE * _left(here)
            here = _Nodes(here.m, here.squares, np.where(divided, split.rho, here.rho))
        levels.append(_Step(here, 0, divided, lower))
        planes.append(plane)
    return _collected(levels[::-1], planes[::-1])


def _finest(broad: np.ndarray) -> int:
    """Halvings of x: as many as there are for one effective sample in each interval."""
    w, squares = broad.sum((1, 2, 3, 4))
    n = w**2 / squares if squares > 0 else 1.0
    return min(FINE[0].bit_length() - 1, max(0, int(np.log2(max(n, 1.0)))))


def _at(k: int, fine: np.ndarray, broad: np.ndarray) -> np.ndarray:
    """Sums in 2^k intervals of x, with the cells of directions that are kept for so many: (2, 2, 2^k, U, V)."""
    table = broad if 2**k <= BROAD[0] else fine
    return table.reshape(2, 2, 2**k, -1, *table.shape[3:]).sum(3)


def _part(nodes: _Nodes, which: int, axis: int) -> _Nodes:
    """Every other node along `axis`: the lower (0) or the upper (1) of each pair."""
    index = [slice(None)] * nodes.m.ndim
    index[axis] = slice(which, None, 2)
    return _Nodes(*(a[tuple(index)] for a in (nodes.m, nodes.squares, nodes.rho)))


def _probability(a: _Nodes, b: _Nodes) -> np.ndarray:
    """Of the first of two boxes of one size, relative to an even half: in [LEAST_HALF, 2 − LEAST_HALF]."""
    share = _over(np.sqrt(a.m * a.rho), np.sqrt(a.m * a.rho) + np.sqrt(b.m * b.rho), 0.5)
    n = _over(np.square(a.m + b.m), a.squares + b.squares, 0.0)
    return 1 + (1 - LEAST_HALF) * n / (n + DOUBT) * (2 * share - 1)


def _over(a: np.ndarray, b: np.ndarray, otherwise: float) -> np.ndarray:
    """a / b, or `otherwise` where b is 0."""
    return np.where(b > 0, a / np.where(b > 0, b, 1), otherwise)


def _merged(a: _Nodes, b: _Nodes) -> tuple[_Nodes, np.ndarray]:
    """Nodes that are divided into `a` and `b`, and the probabilities of `a`, of all samples together."""
    q = _probability(a, b)[::-1]  # that of the other half of the samples
    m = a.m + b.m
    rho = _over(a.m * a.rho / q + b.m * b.rho / (2 - q), m, 1.0)
    return _Nodes(m, a.squares + b.squares, rho), _probability(_together(a), _together(b)) / 2


def _together(nodes: _Nodes) -> _Nodes:
    """Of all samples."""
    m = nodes.m.sum(0)
    return _Nodes(m, nodes.squares.sum(0), _over((nodes.m * nodes.rho).sum(0), m, 1.0))


def _left(nodes: _Nodes) -> np.ndarray:
    """What is left of the second moment, by both halves; all of it where one of them has seen nothing."""
    return np.where(nodes.m.min(0) > 0, np.sqrt(nodes.rho[0] * nodes.rho[1]), 1.0)


def _planes(sums: np.ndarray) -> list[_Step]:
    """From fine to coarse: from the cells of directions, (2, 2, X, U, V), up to one box for each interval of x, by
    halving v and u in turn.
    """
    nodes = _Nodes(*sums, np.ones_like(sums[0]))
    steps = [_Step(nodes, LEAF, None, None)]
    while nodes.m.shape[2] * nodes.m.shape[3] > 1:
        axis = 2 if nodes.m.shape[3] >= nodes.m.shape[2] else 1
        split, lower = _merged(_part(nodes, 0, axis + 1), _part(nodes, 1, axis + 1))
        divided = _left(split) < WORTHWHILE
        nodes = _Nodes(split.m, split.squares, np.where(divided, split.rho, 1.0))
        steps.append(_Step(nodes, axis, divided, lower))
    return steps


def _collected(levels: list[_Step], planes: list[list[_Step]]) -> Tree:
    """The nodes that are reached from the root, breadth first.

    `levels`: by number of halvings of x; `planes`: for each of them the steps of `_planes`.
    """
    axis, lower = [], []
    top = [len(plane) - 1 for plane in planes]
    # halvings of x, interval, step of its plane (above all of them: along x), place in the plane
    queue = [(0, 0, len(planes[0]), 0, 0)]
    for k, i, step, u, v in queue:  # which grows
        if step > top[k]:
            level = levels[k]
            if level.divided is not None and level.divided[i]:
                axis.append(0)
                lower.append(level.lower[i])
                queue += [(k + 1, 2 * i + j, top[k + 1] + 1, 0, 0) for j in (0, 1)]
                continue
            step = top[k]
        at = planes[k][step]
        if at.divided is None or not at.divided[i, u, v]:
            axis.append(LEAF)
            lower.append(0.5)
            continue
        axis.append(at.axis)
        lower.append(at.lower[i, u, v])
        queue += [(k, i, step - 1, 2 * u + j, v) if at.axis == 1 else (k, i, step - 1, u, 2 * v + j) for j in (0, 1)]
    return Tree(np.array(axis, np.uint8), np.array(lower, float), float(_left(levels[0].nodes)[0]))
