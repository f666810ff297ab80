"""Which pairs of shapes may cut into each other? By bounding boxes; and which of them are not covered."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot, key_of
from ..errors import UnsupportedWarning
from ..scene.names import shown_name
from .intersections import RESTING
from .tessellation import cut_each_other

#: Names of the pairs that have been warned about.
SAID: Slot[set[tuple[str | int, str | int]]] = Slot(set)

#: Pairs that a warning names, at most.
NAMED = 3

#: Shapes without triangles.
ANALYTIC = ("disk", "cylinder", "sphere", "bsplinecurve", "linearcurve", "sdfgrid", "ellipsoids")


def box_of(shape: mi.Shape) -> np.ndarray:
    box = shape.bbox()
    return np.array([box.min, box.max], dtype=float)


def apart(lower, upper, box: mi.ScalarBoundingBox3f) -> bool:
    """Does the box with these corners not even touch `box`?"""
    return any(lower[i] > box.max[i] or upper[i] < box.min[i] for i in range(3))


def touching_boxes(boxes: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs i < j of boxes (2, 3) that touch."""
    if len(boxes) < 2:
        return []
    lower, upper = np.stack(boxes, axis=1)
    i, j = np.triu_indices(len(boxes), 1)
    tol = RESTING * (np.abs(np.stack([lower, upper])).max() + np.linalg.norm(upper - lower, axis=1).max())
    near = np.all(np.maximum(lower[i], lower[j]) <= np.minimum(upper[i], upper[j]) + tol, axis=1)
    return list(zip(i[near].tolist(), j[near].tolist(), strict=True))


def crossing(boxes: list[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs i < j of boxes (2, 3) whose shapes may cut into each other. Touching is not cutting."""
    if len(boxes) < 2:
        return []
    lower, upper = np.stack(boxes, axis=1)
    i, j = np.triu_indices(len(boxes), 1)
    size = np.abs(np.stack(boxes)).max((1, 2)) + np.linalg.norm(upper - lower, axis=1)
    tol = RESTING * np.maximum(size[i], size[j])[:, None]
    common_lower, common_upper = np.maximum(lower[i], lower[j]), np.minimum(upper[i], upper[j])
    flat_i, flat_j = (upper[k] - lower[k] <= tol for k in (i, j))
    # A flat shape cuts what extends to both of its sides; two flat ones in one plane do not.
    lower_of_thick, upper_of_thick = (np.where(flat_i, side[j], side[i]) for side in (lower, upper))
    through = (common_lower > lower_of_thick + tol) & (common_upper < upper_of_thick - tol)
    through &= (common_lower <= common_upper + tol) & (flat_i ^ flat_j)
    cuts = np.all((common_upper - common_lower > tol) | through, axis=1)
    return list(zip(i[cuts].tolist(), j[cuts].tolist(), strict=True))


def warn_about_pairs(shapes: list[tuple[mi.Shape, str]], pairs: list[tuple[int, int]], memory: Memory) -> None:
    """Warn once about those of `pairs` of `(shape, plugin)` that cut into each other along a curve not looked for.

    `pairs`: those whose boxes overlap.
    """
    found = []
    for i, j in pairs:
        (a, kind_a), (b, kind_b) = shapes[i], shapes[j]
        curved = [kind for kind in (kind_a, kind_b) if kind in ANALYTIC]
        covered = not curved or curved in (["sphere"], ["cylinder"])
        covered |= curved == ["sphere", "sphere"] and _apart(box_of(a), box_of(b))
        key = (key_of(a), key_of(b))
        if not covered and key not in memory[SAID] and cut_each_other(shapes[i], shapes[j]):
            memory[SAID].add(key)
            found.append(f"'{shown_name(a)}' ({kind_a}) and '{shown_name(b)}' ({kind_b})")
    if found:
        others = f", and {len(found) - NAMED} other pairs" if len(found) > NAMED else ""
        warnings.warn(
            f"shapes {', '.join(found[:NAMED])}{others} cut into each other: the curve where they meet is found for "
            "meshes and for a sphere or cylinder in a mesh only, its part of the derivative is missing; replace curved "
            "shapes by meshes",
            UnsupportedWarning,
            stacklevel=2,
        )


def _apart(a: np.ndarray, b: np.ndarray) -> bool:
    """Two balls, given by their boxes, that do not meet, or of which one lies inside the other."""
    distance = np.linalg.norm(a.mean(0) - b.mean(0))
    r_a, r_b = (box[1, 0] / 2 - box[0, 0] / 2 for box in (a, b))
    return distance >= r_a + r_b or distance <= abs(r_a - r_b)
