"""Where the lines of a pattern cross a surface: patches, and the lines on each, as rows of an edge table.

A *patch* is a triangle in texture coordinates on which these are an affine function of the surface's own coordinates
q: barycentric ones on a face of a mesh, the texture coordinates themselves on shapes without triangles. Parallel lines
of all textures of a shape become one sorted list, so that a line that two textures share is one line. A row is up to
`BLOCK` neighbouring lines on one patch, whose pieces are found in closed form: with the corners sorted across the
lines, line c leaves through the side 0–2 and through 0–1 or 1–2. A line belongs to a patch with s_0 ≤ c < s_2, so that
of patches side by side one has it. Host arrays; they depend on texture coordinates, never on where the surface is.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..scene.patterns import StepFamily

#: Lines of a row at most: their common parameter t is a float, of which each keeps 18 bits.
BLOCK = 32

#: Parallel lines of one texture on one shape, at most.
MOST_LINES = 2**20

#: Sine of the angle below which two families of lines count as parallel.
PARALLEL = 1e-6

#: Share of the distance between lines below which two are one.
SAME_LINE = 1e-4

#: How far beside a line its sides are looked at, in distances to the next line, and in sizes of the shape at most.
INSET, LARGEST_INSET = 1e-2, 1e-4

#: A line this close to a side of a face runs along it: in distances to the next line, and in heights of the face. The
#: second is the depth at which an edge of a mesh looks at its faces (a third of `points.INSET`).
ALONG, ALONG_FACE = 1e-3, 1e-4


@dataclass(frozen=True)
class Lines:
    """Parallel lines n·(u, v) = s, sorted."""

    n: np.ndarray  # (2,) unit
    s: np.ndarray  # (N,)
    gap: np.ndarray  # (N,) distance to the next line on either side


@dataclass(frozen=True)
class Patches:
    """Triangles of one shape."""

    uv: np.ndarray  # (P, 3, 2)
    q: np.ndarray  # (P, 3, 2)
    part: np.ndarray  # (P,) the face of a mesh, or which sort of shape


@dataclass
class PatternRows:
    """One entry per row; detached device arrays. Numbers across the lines count from the first line of the block."""

    shape: mi.UInt32  # index into the shapes of the kind
    part: mi.UInt32  # as of `Patches`
    v0: mi.UInt32  # of a mesh: the corners of its face, by global vertex index
    v1: mi.UInt32
    v2: mi.UInt32
    line: mi.UInt32  # the first line, in `PatternSet.s`
    count: mi.UInt32  # of lines
    s0: mi.Float  # corners of the patch across the lines, s0 ≤ s1 ≤ s2
    s1: mi.Float
    s2: mi.Float
    q0: mi.Point2f  # the same corners in the surface's coordinates
    q1: mi.Point2f
    q2: mi.Point2f
    step: mi.Point2f  # dq/ds across the lines


@dataclass(frozen=True)
class PatternSet:
    """Lines of patterns on the patches of several shapes."""

    rows: PatternRows
    s: mi.Float  # by line: from the first of its block
    inset: mi.Float  # by line: how far beside it its sides are, in texture coordinates


@dataclass(frozen=True)
class End:
    """The line n·(u, v) = s, at which the texture coordinates of a shape end: at its rim, or where they start anew."""

    n: np.ndarray  # (2,) unit
    s: float
    seam: bool  # they start anew: a texture may step


def parallel_lines(families: list[StepFamily], uv: np.ndarray, ends: tuple[End, ...] = ()) -> list[Lines]:
    """All lines that may cross the points `uv` (N, 2), by direction; at `ends` there are none but those of seams."""
    if not families:
        return []
    found: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for n, s in [_across(family, uv) for family in families] + [(end.n, np.zeros(0)) for end in ends if end.seam]:
        same = [entry for entry in found if _parallel(entry[0], n)]
        if same:
            same[0][1].append(s * np.sign(same[0][0] @ n))
        else:
            found.append((n, [s]))
    merged = [(n, _ended(n, _merged(np.sort(np.concatenate(parts))), ends)) for n, parts in found]
    return [Lines(n, s, _gaps(s, np.ptp(uv @ n))) for n, s in merged if len(s)]


def _parallel(a: np.ndarray, b: np.ndarray) -> bool:
    return abs(a[0] * b[1] - a[1] * b[0]) < PARALLEL


def _ended(n: np.ndarray, s: np.ndarray, ends: tuple[End, ...]) -> np.ndarray:
    """Sorted lines across `n` without those at `ends`, but with those of seams."""
    own = [(end.s * (end.n @ n), end.seam) for end in ends if _parallel(end.n, n)]
    tolerance = ALONG * (np.diff(s).min() if len(s) > 1 else 1.0)
    for place, _ in own:
        s = s[np.abs(s - place) > tolerance]
    return np.sort(np.append(s, [place for place, seam in own if seam]))


def too_fine(family: StepFamily, uv: np.ndarray) -> bool:
    """Has it more lines among the points `uv` (N, 2) than anyone could see?"""
    return float(np.ptp(uv @ family.a)) > MOST_LINES


def _across(family: StepFamily, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vector across the lines of `family`, and where those among the points `uv` lie."""
    length = np.linalg.norm(family.a)
    if length == 0:
        return np.array([1.0, 0.0]), np.zeros(0)
    n = family.a / length
    reach = uv @ n
    k = family.within(reach.min() * length + family.b, reach.max() * length + family.b)
    return n, (k - family.b) / length


def _merged(s: np.ndarray) -> np.ndarray:
    """Sorted lines, each once."""
    if len(s) < 2:
        return s
    apart = np.diff(s)
    typical = np.median(apart[apart > 0]) if (apart > 0).any() else 1.0
    return s[np.concatenate([[True], apart > SAME_LINE * typical])]


def _gaps(s: np.ndarray, reach: float) -> np.ndarray:
    if len(s) < 2:
        return np.full(len(s), max(reach, np.finfo(np.float32).tiny))
    apart = np.diff(s)
    return np.minimum(np.append(apart, np.inf), np.insert(apart, 0, np.inf))


def sides_on_lines(face_uv: np.ndarray, families: list[Lines]) -> np.ndarray:
    """(F, 3) bool: do sides of faces with texture coordinates (F, 3, 2) run along a line? Side i is opposite corner i.

    There the step lies on an edge of the mesh.
    """
    found = np.zeros(face_uv.shape[:2], bool)
    for lines in families:
        s = face_uv @ lines.n
        tolerance = _tolerance(lines, s)
        for i in range(3):
            a, b = s[:, (i + 1) % 3], s[:, (i + 2) % 3]
            nearest = np.clip(np.searchsorted(lines.s, a), 1, max(len(lines.s) - 1, 1))
            for k in (nearest - 1, np.minimum(nearest, len(lines.s) - 1)):
                off = np.maximum(np.abs(a - lines.s[k]), np.abs(b - lines.s[k]))
                found[:, i] |= off <= tolerance
    return found


def _tolerance(lines: Lines, s: np.ndarray) -> np.ndarray:
    """How close to a line a side of a face (corners at `s` (F, 3) across the lines) has to be to count as along it."""
    gap = lines.gap.min()
    return np.minimum(ALONG * gap + ALONG_FACE * np.ptp(s, axis=1), gap / 4)


def rows_on(patches: Patches, face_uv: np.ndarray | None, lines: Lines, step: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of `lines` on `patches`, as columns of `PatternRows`; their first lines count within `lines`.

    `face_uv` (F, 3, 2): of a mesh, whose sides along lines are left to its edges. `step` (P, 2): dq/ds by patch.
    """
    s = patches.uv @ lines.n
    order = np.argsort(s, axis=1, kind="stable")
    s = np.take_along_axis(s, order, 1)
    q = np.take_along_axis(patches.q, order[:, :, None], 1)
    low, high = s[:, 0], s[:, 2]
    if face_uv is not None:
        low, high = _without_sides(lines, np.sort(face_uv @ lines.n, axis=1)[patches.part], low, high)
    first, end = np.searchsorted(lines.s, low), np.searchsorted(lines.s, high)
    # pieces of [first, end) that lie within one block of lines
    pieces = np.where(end > first, (end - 1) // BLOCK - first // BLOCK + 1, 0)
    patch = np.repeat(np.arange(len(first)), pieces)
    number = np.arange(len(patch)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    block = first[patch] // BLOCK + number
    line, after = np.maximum(first[patch], block * BLOCK), np.minimum(end[patch], (block + 1) * BLOCK)
    s = s[patch] - lines.s[block * BLOCK][:, None]
    columns = {"part": patches.part[patch], "line": line, "count": after - line, "step": step[patch]}
    columns |= {f"s{i}": s[:, i] for i in range(3)}
    columns |= {f"q{i}": q[patch, i] for i in range(3)}
    return columns


def _without_sides(lines: Lines, face: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The range across the lines in which a patch has lines that do not run along a side of its face.

    `face`: (P, 3) sorted corners of the face of each patch, across the lines.
    """
    tolerance = _tolerance(lines, face)
    below, above = face[:, 1] - face[:, 0] <= tolerance, face[:, 2] - face[:, 1] <= tolerance
    low = np.where(below, np.maximum(low, face[:, 1] + tolerance), low)
    high = np.where(above, np.minimum(high, face[:, 1] - tolerance), high)
    return low, high


def pattern_set(parts: list[tuple[Lines, dict[str, np.ndarray]]]) -> PatternSet | None:
    """The rows of several `(lines, rows)`, all columns filled in, in one table; None without any."""
    parts = [part for part in parts if len(part[1]["line"])]
    if not parts:
        return None
    columns: dict[str, list[np.ndarray]] = {field.name: [] for field in fields(PatternRows)}
    s, inset, first = [], [], 0
    for lines, rows in parts:
        for name, values in rows.items():
            columns[name].append(values + first if name == "line" else values)
        start = lines.s[np.arange(len(lines.s)) // BLOCK * BLOCK]
        s.append(lines.s - start)
        size = max(np.ptp(lines.s), lines.gap.max())
        inset.append(np.minimum(INSET * lines.gap, LARGEST_INSET * size))
        first += len(lines.s)
    kinds = PatternRows.__annotations__
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    rows = PatternRows(**{name: _device(kinds[name], values) for name, values in joined.items()})
    return PatternSet(rows, uploaded(mi.Float, np.concatenate(s)), uploaded(mi.Float, np.concatenate(inset)))


def _device(kind: str, values: np.ndarray):
    """A column on the device; `kind` as annotated."""
    if kind == "mi.Point2f":
        return mi.Point2f(*(uploaded(mi.Float, column) for column in values.T))
    return uploaded(mi.UInt32 if kind == "mi.UInt32" else mi.Float, values)
