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
    if len(lower_a) == 0 or len(lower_b) == 0:
        return
    origin, h = np.minimum(lower_a.min(0), lower_b.min(0)), _cell(lower_a, upper_a, lower_b, upper_b)
    first_a, last_a, first_b, last_b = (
        np.floor((x - origin) / h).astype(np.int64) for x in (lower_a, upper_a, lower_b, upper_b)
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
        own = np.repeat(np.arange(begin, stop), count)
        within = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
        a, b = i[own], j[start[own] + within]
        # a pair shares many cells: it counts in the lowest of these
        here = np.all(np.maximum(first_a[a], first_b[b]) == cell_a[own], axis=1)
        here &= np.all((lower_a[a] <= upper_b[b]) & (lower_b[b] <= upper_a[a]), axis=1)
        yield a[here], b[here]
        begin = stop


def _cell(lower_a, upper_a, lower_b, upper_b) -> float:
    """Width of the cells."""
    sizes = [(upper - lower).max(1) for lower, upper in ((lower_a, upper_a), (lower_b, upper_b))]
    extent = max(upper_a.max(), upper_b.max()) - min(lower_a.min(), lower_b.min())
    h = max(CELL * max(float(np.median(size)) for size in sizes), extent / 2 ** (BITS - 1), np.finfo(float).tiny)
    while sum(_count(lower, upper, h) for lower, upper in ((lower_a, upper_a), (lower_b, upper_b))) > ENTRIES * (
        len(lower_a) + len(lower_b)
    ):
        h *= 2
    return h


def _count(lower: np.ndarray, upper: np.ndarray, h: float) -> float:
    """Entries of boxes in cells of width h, about."""
    return float(np.prod(np.floor((upper - lower) / h) + 1, axis=1).sum())


def _entries(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every cell of every box: the number of the box, and the cell (K, 3)."""
    size = last - first + 1
    count = size.prod(1)
    box = np.repeat(np.arange(len(first)), count)
    rest = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
    cell = np.empty((len(box), 3), np.int64)
    for axis in range(3):
        cell[:, axis] = first[box, axis] + rest % size[box, axis]
        rest //= size[box, axis]
    return box, cell


def _key(cell: np.ndarray) -> np.ndarray:
    return (cell[:, 0] << (2 * BITS)) | (cell[:, 1] << BITS) | cell[:, 2]
