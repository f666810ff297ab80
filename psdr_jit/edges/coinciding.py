"""Edges at the same place are one discontinuity: whole edges of several shapes, and parts of edges.

An edge that shares a part of its length with another one is divided where the common part begins and ends; its pieces
then coincide with the other one as a whole. What lies beside a piece is found by tracing rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import starts
from ..core.upload import uploaded
from .contacts import Contact
from .rows import EdgeRows
from .solids import Solid
from .topology import weld_vertices

#: Coinciding edges are looked for among all edges up to this many, among borders only beyond (a cost per call).
MAX_COMPARED_EDGES = 20000

#: Share of an edge's length next to its ends in which it is not divided: rounding.
AT_THE_END = 1e-5


@dataclass(frozen=True)
class PointsBetween:
    """Points (1 - t) a + t b on edges from vertex a to vertex b, which move as these do."""

    a: mi.UInt32
    b: mi.UInt32
    t: mi.Float

    def added_to(self, values: mi.Float | mi.Point3f) -> mi.Float | mi.Point3f:
        """`values` of all vertices, and after these those of the points."""
        of = type(values)
        own = (1 - self.t) * dr.gather(of, values, self.a) + self.t * dr.gather(of, values, self.b)
        if dr.depth_v(of) == 1:
            return dr.concat([values, own])
        return of(*(dr.concat([values[axis], own[axis]]) for axis in range(3)))


def divided(
    rows: EdgeRows, solids: Sequence[Solid], contacts: Sequence[Contact], vertices: int
) -> tuple[EdgeRows, PointsBetween | None, np.ndarray]:
    """Rows of `solids`, in order, divided where parts of them run along each other: `(rows, ends, shared)`.

    `ends`: new ends of rows, numbered after the `vertices`; None if nothing is divided. `shared`: rows that may
    coincide with others. Only edges that all move, or all rest, are divided: see `join_coinciding`.
    """
    first = starts([len(solid.topology) for solid in solids])
    cuts: dict[int, dict[float, tuple[int, int]]] = {}  # by row: parameters, and the row and end that lies there
    shared: set[int] = set()
    for contact in contacts:
        if contact.a.moves != contact.b.moves:
            continue
        of_a, of_b = first[contact.a.index] + contact.shared.a, first[contact.b.index] + contact.shared.b
        shared.update(of_a.tolist(), of_b.tolist())
        for row, other, on_row, on_other in (
            (of_a, of_b, contact.shared.on_a, contact.shared.on_b),
            (of_b, of_a, contact.shared.on_b, contact.shared.on_a),
        ):
            k, end = np.nonzero((on_row > AT_THE_END) & (on_row < 1 - AT_THE_END))
            for r, o, t, s in zip(row[k], other[k], on_row[k, end], on_other[k, end], strict=True):
                cuts.setdefault(int(r), {})[float(t)] = (int(o), int(round(s)))
    if not cuts:
        return rows, None, np.array(sorted(shared), int)
    dr.eval(rows)
    return _cut(rows, cuts, shared, vertices)


def _cut(rows: EdgeRows, cuts: dict, shared: set[int], vertices: int):
    p = [np.array(end).T for end in (rows.p0, rows.p1)]
    v = [np.array(end) for end in (rows.v0, rows.v1)]
    whole = np.setdiff1d(np.arange(len(v[0])), list(cuts))
    source, ends, points = [], [], []  # by piece: its row, numbers of its ends; by point: its edge, t, place
    for row, at in cuts.items():
        inner = []
        for t in sorted(at):
            if inner and t - points[-1][2] < AT_THE_END:
                continue  # ends of several edges at one place
            other, end = at[t]
            inner.append(vertices + len(points))
            points.append((v[0][row], v[1][row], t, p[end][other]))
        numbers = [v[0][row], *inner, v[1][row]]
        source += [row] * (len(inner) + 1)
        ends += list(zip(numbers[:-1], numbers[1:], strict=True))
    place = np.array([point[3] for point in points])
    pieces = []
    for row, numbers in zip(source, ends, strict=True):
        pieces.append([place[n - vertices] if n >= vertices else p[k][row] for k, n in enumerate(numbers)])
    found = dr.gather(EdgeRows, rows, uploaded(mi.UInt32, np.concatenate([whole, source])))
    index = uploaded(mi.UInt32, len(whole) + np.arange(len(source)))
    for k, (number, point) in enumerate(((found.v0, found.p0), (found.v1, found.p1))):
        dr.scatter(number, uploaded(mi.UInt32, np.array(ends)[:, k]), index)
        columns = np.array(pieces)[:, k].T
        dr.scatter(point, mi.Point3f(*(uploaded(mi.Float, column) for column in columns)), index)
    dr.scatter(found.traced, mi.Bool(True), index)
    a, b, t = zip(*(point[:3] for point in points), strict=True)
    between = PointsBetween(uploaded(mi.UInt32, a), uploaded(mi.UInt32, b), uploaded(mi.Float, t))
    dr.eval(found, between)
    compared = np.concatenate([np.searchsorted(whole, sorted(shared - set(cuts))), len(whole) + np.arange(len(source))])
    return found, between, compared.astype(int)


def join_coinciding(rows: EdgeRows, moving: list[bool], shared: np.ndarray) -> EdgeRows:
    """Edges at the same place become one row; `shared`: rows that are looked at however many there are.

    Two borders become an edge with two faces. More than two, or an edge on an edge (stacked boxes), keep one row whose
    sides are found by tracing rays, because topology no longer says which face is on top. Rows of a moving and of a
    static shape are left apart: their motion relative to each other is what counts.
    """
    dr.eval(rows)
    border = np.array(rows.border)
    few = len(border) <= MAX_COMPARED_EDGES
    candidate = np.arange(len(border)) if few else np.union1d(np.flatnonzero(border), shared)
    if len(candidate) < 2:
        return rows
    group = _coinciding(rows, candidate, np.array(moving)[np.array(rows.shape0)[candidate]])
    if len(group) == 0:
        return rows
    plain = border & ~np.array(rows.traced)  # a piece of a border is not all of its face's side
    pairs = [g for g in group if len(g) == 2 and plain[g].all()]
    others = [g for g in group if not (len(g) == 2 and plain[g].all())]
    if pairs:
        _join_borders(rows, np.array(pairs))
    for g in others:
        dr.scatter(rows.traced, mi.Bool(True), uploaded(mi.UInt32, g[:1]))
    keep = np.ones(len(border), bool)
    for g in group:
        keep[g[1:]] = False
    return dr.gather(EdgeRows, rows, uploaded(mi.UInt32, np.flatnonzero(keep)))


def _coinciding(rows: EdgeRows, candidate: np.ndarray, motion: np.ndarray) -> list[np.ndarray]:
    """Groups of two or more rows with the same end points and the same entry in `motion`."""
    index = uploaded(mi.UInt32, candidate)
    ends = [np.array(dr.gather(mi.Point3f, p, index)).T for p in (rows.p0, rows.p1)]
    start, end = weld_vertices(np.concatenate(ends)).reshape(2, -1)
    count = max(start.max(), end.max()) + 1
    key = (np.minimum(start, end) * count + np.maximum(start, end)) * 2 + motion
    order = np.argsort(key, kind="stable")
    _, first, length = np.unique(key[order], return_index=True, return_counts=True)
    return [candidate[order[i : i + n]] for i, n in zip(first[length > 1], length[length > 1], strict=True)]


def _join_borders(rows: EdgeRows, pairs: np.ndarray) -> None:
    """Give the first border of every pair the second one's face, in place."""
    a, b = uploaded(mi.UInt32, pairs[:, 0]), uploaded(mi.UInt32, pairs[:, 1])

    def of(values, index):
        return dr.gather(type(values), values, index)

    # Seen from face a, face b continues the surface if it runs along the edge the other way round.
    parallel = dr.dot(of(rows.p1, a) - of(rows.p0, a), of(rows.p1, b) - of(rows.p0, b)) > 0
    n1, corner1 = of(rows.n0, b), of(rows.corner0, b)
    dr.scatter(rows.n1, dr.select(parallel, -n1, n1), a)
    dr.scatter(rows.corner1, dr.select(parallel, corner1, mi.Vector2u(corner1.y, corner1.x)), a)
    dr.scatter(rows.prim1, of(rows.prim0, b), a)
    dr.scatter(rows.inset1, of(rows.inset0, b), a)
    dr.scatter(rows.shape1, of(rows.shape0, b), a)
    dr.scatter(rows.border, mi.Bool(False), a)
    dr.scatter(rows.smooth, mi.Bool(False), a)
    dr.scatter(rows.seam, mi.Bool(True), a)
