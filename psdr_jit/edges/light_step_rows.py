"""The steps of a light in its own film, as rows: frames and texel borders of pictures, rims of cones.

The film of a light is the plane z = 1 in front of it, in the texture coordinates of its picture. A row is a piece of a
straight line there, or an arc of the rim. Host arrays; they depend on textures, never on where the light is.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..scene.patterns import StepFamily
from .pattern_rows import INSET, LARGEST_INSET, End, Lines, parallel_lines

#: The picture, in texture coordinates.
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
ACROSS = np.eye(2)

#: Its sides. Of a projector they are steps of their own, and they touch the cone of a spot from outside: no line that
#: lies on them counts.
FRAME = tuple(End(n, s, False) for n in ACROSS for s in (0.0, 1.0))

#: Pieces of a line: each is drawn as often as it is bright. Fewer where there would be more rows than `MOST_ROWS`.
PIECES, MOST_ROWS = 16, 2**20


@dataclass
class LightStepRows:
    """One entry per row; detached device arrays."""

    light: mi.UInt32  # among the lights with steps
    arc: mi.UInt32  # 1: of the rim of the cone, between angles a.x and b.x about its axis; 0: a line on the film
    a: mi.Point2f  # where it begins, in texture coordinates
    b: mi.Point2f  # where it ends
    inset: mi.Float  # how far beside it its sides are looked at, in texture coordinates


def rows_of_light(families: list[StepFamily], framed: bool, rim: bool) -> dict[str, np.ndarray]:
    """Columns of `LightStepRows` but for the light: lines of a picture, its frame, the rim of a cone."""
    lines = parallel_lines(families, CORNERS, FRAME)
    if framed:
        gap = min([1.0, *(found.gap.min() for found in lines)])
        lines += [Lines(n, np.array([0.0, 1.0]), np.full(2, gap)) for n in ACROSS]
    count = sum(len(found.s) for found in lines)
    parts = [_pieces(found, int(np.clip(MOST_ROWS // max(count, 1), 1, PIECES))) for found in lines]
    if rim:
        parts.append(_rim())
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def _pieces(lines: Lines, pieces: int) -> dict[str, np.ndarray]:
    """The part of each line that lies on the picture, cut into equal pieces."""
    along, foot = np.array([-lines.n[1], lines.n[0]]), lines.s[:, None] * lines.n
    low, high = np.full(len(foot), -np.inf), np.full(len(foot), np.inf)
    for axis in range(2):
        if along[axis] == 0:
            continue
        ends = np.sort(((0 - foot[:, axis]) / along[axis], (1 - foot[:, axis]) / along[axis]), axis=0)
        low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
    crosses = high > low
    low, high, foot, gap = low[crosses], high[crosses], foot[crosses], lines.gap[crosses]
    cuts = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, pieces + 1)
    points = foot[:, None] + cuts[:, :, None] * along
    inset = np.repeat(np.minimum(INSET * gap, LARGEST_INSET), pieces)
    return {"arc": np.zeros(len(inset), int), "a": points[:, :-1].reshape(-1, 2), "b": points[:, 1:].reshape(-1, 2),
            "inset": inset}  # fmt: skip


def _rim() -> dict[str, np.ndarray]:
    cuts = np.linspace(0, 2 * np.pi, PIECES + 1)
    points = np.stack([cuts, np.zeros(PIECES + 1)], 1)
    return {"arc": np.ones(PIECES, int), "a": points[:-1], "b": points[1:], "inset": np.full(PIECES, LARGEST_INSET)}


def light_step_rows(parts: list[dict[str, np.ndarray]]) -> LightStepRows | None:
    """The rows of several lights, in order, in one table; None without any."""
    parts = [{**part, "light": np.full(len(part["arc"]), k)} for k, part in enumerate(parts) if part]
    if not parts:
        return None
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    ends = (mi.Point2f(*(uploaded(mi.Float, column) for column in joined[name].T)) for name in ("a", "b"))
    indices = (uploaded(mi.UInt32, joined[name]) for name in ("light", "arc"))
    return LightStepRows(*indices, *ends, uploaded(mi.Float, joined["inset"]))
