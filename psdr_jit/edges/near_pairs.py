"""Which of many boxes overlap which? A uniform grid, joined cell by cell. Pure NumPy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

#: Width of a cell, in units of the larger of both sides' typical boxes.
CELL = 1.5

#: Entries of boxes in cells, on average, beyond which cells are made larger.
ENTRIES = 8

#: Bits of a cell's number along each axis.
BITS = 20

#: Pairs that are handed out at once.
CHUNK = 1 << 20


def near_pairs(
    lower_a: np.ndarray, upper_a: np.ndarray, lower_b: np.ndarray, upper_b: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """All pairs (i, j) for which the boxes a_i (N, 3) and b_j (M, 3) overlap, each once, in parts `(i, j)`."""
    boxes_a, boxes_b = (lower_a, upper_a), (lower_b, upper_b)
    own, other = _within_reach(boxes_a, boxes_b), _within_reach(boxes_b, boxes_a)
    if len(own) == 0 or len(other) == 0:
        return
    low_a, high_a = (np.ascontiguousarray(x[own].T) for x in boxes_a)
    low_b, high_b = (np.ascontiguousarray(x[other].T) for x in boxes_b)
    origin, h = np.minimum(low_a.min(1), low_b.min(1))[:, None], _cell(low_a, high_a, low_b, high_b)
    first_a, last_a, first_b, last_b = (
        np.floor((x - origin) / h).astype(np.int64) for x in (low_a, high_a, low_b, high_b)
    )
    i, cell_a = _entries(first_a, last_a)
    j, cell_b = _entries(first_b, last_b)
    key_a, key_b = _key(cell_a), _key(cell_b)
    order = np.argsort(key_b, kind="stable")
    j, key_b = j[order], key_b[order]
    start, end = np.searchsorted(key_b, key_a, "left"), np.searchsorted(key_b, key_a, "right")
    total = np.cumsum(end - start)
    begin = 0
    while begin < len(i):
        before = total[begin - 1] if begin else 0
        stop = max(begin + 1, int(np.searchsorted(total, before + CHUNK, "right")))
        part = slice(begin, stop)
        count = end[part] - start[part]
        entry = np.repeat(np.arange(begin, stop), count)
        within = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
        a, b = i[entry], j[start[entry] + within]
        for axis in range(3):  # one by one: few are left for the last
            near = (low_a[axis][a] <= high_b[axis][b]) & (low_b[axis][b] <= high_a[axis][a])
            # a pair shares many cells: it counts in the lowest of these
            near &= np.maximum(first_a[axis][a], first_b[axis][b]) == cell_a[axis][entry]
            a, b, entry = a[near], b[near], entry[near]
        yield own[a], other[b]
        begin = stop


def _within_reach(boxes: tuple[np.ndarray, np.ndarray], others: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Numbers of the `boxes` that overlap the one box around all others."""
    near = np.full(len(boxes[0]), len(others[0]) > 0)
    if near.any():
        for low, high, other_low, other_high in zip(*(x.T for x in (*boxes, *others)), strict=True):
            near &= (low <= other_high.max()) & (high >= other_low.min())
    return np.flatnonzero(near)


def _cell(low_a, high_a, low_b, high_b) -> float:
    """Width of the cells."""
    sizes = [np.maximum.reduce(high - low) for low, high in ((low_a, high_a), (low_b, high_b))]
    extent = max(high_a.max(), high_b.max()) - min(low_a.min(), low_b.min())
    h = max(CELL * max(float(np.median(size)) for size in sizes), extent / 2 ** (BITS - 1), np.finfo(float).tiny)
    while _count(low_a, high_a, h) + _count(low_b, high_b, h) > ENTRIES * (low_a.shape[1] + low_b.shape[1]):
        h *= 2
    return h


def _count(low: np.ndarray, high: np.ndarray, h: float) -> float:
    """Entries of boxes in cells of width h, about."""
    return float(np.multiply.reduce(np.floor((high - low) / h) + 1).sum())


def _entries(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every cell of every box: the number of the box, and the cell (3, K)."""
    size = last - first + 1
    count = np.multiply.reduce(size)
    box = np.repeat(np.arange(first.shape[1]), count)
    rest = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
    cell = np.empty((3, len(box)), np.int64)
    for axis in range(3):
        along = size[axis][box]
        cell[axis] = first[axis][box] + rest % along
        rest //= along
    return box, cell


def _key(cell: np.ndarray) -> np.ndarray:
    return (cell[0] << (2 * BITS)) | (cell[1] << BITS) | cell[2]
