"""The patterns of a B-spline or linear curve: patches of its segments, and the rows of lines on them.

Texture coordinates are u about the axis and v = (place along the segment + number of the segment) / segments. A patch
is given by its part of a segment, and q is u and the place on that part from 0 to 1. Of a linear curve, v stands still
on the spheres at its ends and joints, and u starts anew at every joint: rings around both ends of its segments take the
place of the lines there.
"""

from __future__ import annotations

from enum import IntEnum

import mitsuba as mi
import numpy as np

from ..scene.curve_ends import SEGMENTS
from ..scene.patterns import StepFamily
from .pattern_rows import BLOCK, End, Lines, Patches, parallel_lines, rows_on
from .pattern_shapes import ShapePatterns

#: Patches around a segment, and along it: no less than the first of one, and not many more than the second of a shape.
AROUND, LEAST_ALONG, ALONG_SHAPE = 16, 2, 32

#: Patches along a sphere at an end, from its pole to its rim.
ON_CAP = 2

#: A line this close to the end of a segment runs along it, in lengths of segments.
AT_END = 1e-3

U, V = np.array([1.0, 0.0]), np.array([0.0, 1.0])

#: u starts anew.
AROUND_ENDS = (End(U, 0.0, True), End(U, 1.0, False))

#: Of texture coordinates.
UNIT = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])


class Part(IntEnum):
    """Of a segment; the place on it is q.y."""

    SIDE = 0  # from v = 0 to 1; all there is of a B-spline
    FIRST_CAP = 1  # the sphere at v = 0, from its pole to its rim
    LAST_CAP = 2  # the sphere at v = 1, from its rim to its pole
    FIRST_RING = 3  # the rim at v = 0 ...
    LAST_RING = 4  # ... and that at v = 1; in both cases, q.y is v


def curve_patterns(shape: mi.Shape, plugin: str, families: list[StepFamily]) -> ShapePatterns:
    """Lines on a curve."""
    first = np.array(mi.traverse(shape)[SEGMENTS]).astype(np.int64)
    joined = np.diff(first) == 1
    segments = _Segments(np.append(False, joined))
    on = segments.on_rods if plugin == "linearcurve" else segments.on_splines
    return ShapePatterns(on(families), None, 0.0)


class _Segments:
    """Of one shape; `follows`: by segment, is there one before it on the same curve? Host arrays."""

    def __init__(self, follows: np.ndarray):
        self.follows, self.count = follows, len(follows)
        self.all = np.arange(self.count)

    def on_splines(self, families: list[StepFamily]) -> list[tuple[Lines, dict[str, np.ndarray]]]:
        """A line at the end of a curve has but one side."""
        ends = np.append(self.all[~self.follows], self.count)
        lines = parallel_lines(families, UNIT, (*AROUND_ENDS, *self._without(ends)))
        return [(each, self._sides(each)) for each in lines]

    def on_rods(self, families: list[StepFamily]) -> list[tuple[Lines, dict[str, np.ndarray]]]:
        lines = parallel_lines(families, UNIT, (*AROUND_ENDS, *self._without(np.arange(self.count + 1))))
        found = [(each, self._sides(each)) for each in lines]
        for each in lines:
            found.append((each, self._caps(each, self.all[~self.follows], Part.FIRST_CAP)))
            found.append((each, self._caps(each, self.all, Part.LAST_CAP)))
        if families:
            found.append(self._rings(self.all[self.follows], Part.FIRST_RING))
            stepped = self._stepped_ends(parallel_lines(families, UNIT))
            found.append(self._rings(stepped, Part.LAST_RING))
        return found

    def _without(self, ends: np.ndarray) -> list[End]:
        return [End(V, k / self.count, False) for k in ends]

    def _stepped_ends(self, lines: list[Lines]) -> np.ndarray:
        """Segments at whose end the texture steps from one v to the next."""
        along = [each.s * (each.n @ V) for each in lines if abs(each.n @ U) < AT_END]
        place = np.concatenate(along) * self.count if along else np.zeros(0)
        number = np.round(place).astype(np.int64)
        number = number[(np.abs(place - number) < AT_END) & (number > 0)]
        return np.unique(number) - 1

    def _sides(self, lines: Lines) -> dict[str, np.ndarray]:
        along = max(LEAST_ALONG, ALONG_SHAPE // self.count)
        q, segment = _grid(along, self.all)
        uv = np.stack([q[..., 0], (q[..., 1] + segment[:, None]) / self.count], -1)
        step = np.tile(lines.n * np.array([1, self.count]), (len(q), 1))
        return self._rows(Patches(uv, q, np.arange(len(q))), segment, lines, step, Part.SIDE)

    def _caps(self, lines: Lines, segments: np.ndarray, part: Part) -> dict[str, np.ndarray]:
        """v stands still there."""
        q, segment = _grid(ON_CAP, segments)
        v = (segment + (part is Part.LAST_CAP)) / self.count
        uv = np.stack([q[..., 0], np.broadcast_to(v[:, None], q.shape[:2])], -1)
        across = lines.n[0] if abs(lines.n[0]) > AT_END else np.inf
        step = np.tile([1 / across, 0.0], (len(q), 1))
        return self._rows(Patches(uv, q, np.arange(len(q))), segment, lines, step, part)

    def _rings(self, segments: np.ndarray, part: Part) -> tuple[Lines, dict[str, np.ndarray]]:
        """One line each, in pieces."""
        end = float(part is Part.LAST_RING)
        s = (segments + end) / self.count
        lines = Lines(V, s, np.full(len(s), 1 / self.count))
        ring = np.repeat(np.arange(len(s)), AROUND)
        u = np.tile(np.arange(AROUND) / AROUND, len(s))
        place = s[ring] - s[ring // BLOCK * BLOCK]
        ends = [np.stack([at, np.full(len(u), end)], -1) for at in (u, u + 1 / AROUND)]
        step = np.tile([0.0, self.count], (len(u), 1))
        rows = {"part": np.full(len(u), int(part)), "line": ring, "count": np.ones(len(u)), "step": step,
                "s0": place, "s1": place, "s2": place + 1, "q0": ends[0], "q1": ends[1], "q2": ends[0]}  # fmt: skip
        return lines, _at_segments(rows, segments[ring])

    def _rows(
        self, patches: Patches, segment: np.ndarray, lines: Lines, step: np.ndarray, part: Part
    ) -> dict[str, np.ndarray]:
        rows = rows_on(patches, None, lines, step)
        of = segment[rows["part"]]
        rows["part"] = np.full(len(of), int(part))
        return _at_segments(rows, of)


def _at_segments(rows: dict[str, np.ndarray], segment: np.ndarray) -> dict[str, np.ndarray]:
    """What a curve has in place of the vertices of a face: the number of the segment."""
    return rows | {"v0": segment, "v1": np.zeros(len(segment)), "v2": np.zeros(len(segment))}


def _grid(along: int, segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (P, 3, 2) in (u, place), and their segments."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(AROUND), np.arange(along), indexing="ij"))
    corner = np.stack([i, j], 1)[:, None]
    halves = (np.array([[0, 0], [1, 0], [0, 1]]), np.array([[1, 1], [0, 1], [1, 0]]))
    cut = np.concatenate([corner + half for half in halves]) / np.array([AROUND, along])
    return np.tile(cut, (len(segments), 1, 1)), np.repeat(segments, len(cut))
