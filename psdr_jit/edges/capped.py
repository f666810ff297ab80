"""Ends of cylinders that disks close, as of cans and coins: two rims in one place.

Each would count the step across them. One is kept, that farther out, and what lies on its two sides is traced: wall
and lid from above, wall and what is behind from below.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..paths.rays import ROUNDING
from .curves import CURVES_OF, PIECES, Curve, CurveSet

#: How far rims may be apart, and their radii, relative to these; and the sine of the angle between their planes.
ALIKE = 1e-4

_ENDS = {Curve.DISK_RIM: 0.0, Curve.CYLINDER_BOTTOM: 0.0, Curve.CYLINDER_TOP: 1.0}  # places along the axis


def joined_rims(curves: CurveSet, plugins: Sequence[str], moving: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
    """By row: `(is it a rim that a disk closes, is it the rim of such a disk)`. Of shapes that both move or both rest:
    where only one does, they part.
    """
    rims = [(i, curve) for i, plugin in enumerate(plugins) for curve in CURVES_OF[plugin]]
    closed, closing = np.zeros(len(rims), bool), np.zeros(len(rims), bool)
    if {"disk", "cylinder"} <= set(plugins):
        axes = [np.array(column).T.astype(float) for column in curves.poses.columns]  # (shapes, 3) each
        ends = [k for k, (_, curve) in enumerate(rims) if curve in _ENDS and curve != Curve.DISK_RIM]
        circles = [_circle([a[i] for a in axes], curve) for i, curve in (rims[k] for k in ends)]
        for lid in (k for k, (_, curve) in enumerate(rims) if curve == Curve.DISK_RIM):
            circle = _circle([a[rims[lid][0]] for a in axes], Curve.DISK_RIM)
            same = [moving[rims[k][0]] == moving[rims[lid][0]] for k in ends]
            found = np.flatnonzero(_coincide(circle, circles) & same & ~closed[ends])
            if len(found):
                end = ends[found[0]]
                shape, curve = rims[end]
                outward = axes[2][shape] * (1 if curve == Curve.CYLINDER_TOP else -1)
                kept, left = (lid, end) if _beyond(circle, circles[found[0]], outward) else (end, lid)
                closed[kept] = closing[left] = True
    return np.repeat(closed, PIECES), np.repeat(closing, PIECES)


def _circle(axes: list[np.ndarray], curve: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, unit normal and the radii along both axes."""
    x, y, z, origin = axes
    normal = np.cross(x, y)
    radii = np.array([np.linalg.norm(x), np.linalg.norm(y)])
    return origin + _ENDS[curve] * z, normal / max(np.linalg.norm(normal), np.finfo(float).tiny), radii


def _beyond(lid: tuple, end: tuple, outward: np.ndarray) -> bool:
    """Is a lid a hair wider than the end that it closes, or does it lie a hair outside of it?"""
    wider = lid[2].max() - end[2].max() > ROUNDING * lid[2].max()
    return wider or outward @ (lid[0] - end[0]) > 0


def _coincide(one: tuple, others: Sequence[tuple]) -> np.ndarray:
    """Which of the others are the same circle? None of an ellipse."""
    (c, n, r), (centres, normals, radii) = one, (np.array(column) for column in zip(*others, strict=True))
    slack = ALIKE * r.max()
    near = np.linalg.norm(centres - c, axis=1) < slack
    near &= (np.ptp(r) < slack) & (np.ptp(radii, axis=1) < slack) & (np.abs(radii[:, 0] - r[0]) < slack)
    return near & (np.linalg.norm(np.cross(normals, n), axis=1) < ALIKE)
