"""Shapes as triangles, to ask whether two of them cut into each other at all. NumPy on the host, detached."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_faces, mesh_positions
from .intersections import cross, tolerance

#: Corners of a tessellated circle; rings of a sphere are half as many.
CORNERS = 96

#: By how much the corners of a polygon are moved outwards, so that it lies around its circle.
AROUND = 1 / np.cos(np.pi / CORNERS)


def cut_each_other(a: tuple[mi.Shape, str], b: tuple[mi.Shape, str]) -> bool:
    """Do the surfaces of two `(shape, plugin)` cross? Curved ones are taken as polyhedra in and around them.

    While a function is being frozen, values cannot be read: they may.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        return True
    for outward in {1.0, AROUND}:
        triangles = [_triangles(shape, plugin, outward) for shape, plugin in (a, b)]
        boxes = [np.stack([t.min((0, 1)), t.max((0, 1))]) for t in triangles]
        if cross(*triangles, tolerance(*boxes)):
            return True
    return False


def _triangles(shape: mi.Shape, plugin: str, outward: float) -> np.ndarray:
    """(F, 3, 3) in world space; radii of circles grow by the factor `outward`."""
    if shape.is_mesh():
        return np.array(dr.detach(mesh_positions(shape)), float).T[np.array(mesh_faces(shape)).T]
    to_world = np.array(dr.detach(mi.traverse(shape)["to_world"].matrix), float).reshape(4, 4)
    turn = 2 * np.pi * np.arange(CORNERS + 1) / CORNERS
    circle = outward * np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    if plugin == "disk":
        rings = [0 * circle, circle]
    elif plugin == "cylinder":
        rings = [circle, circle + [0, 0, 1]]
    else:
        polar = np.linspace(0, np.pi, CORNERS // 2 + 1)
        rings = [np.sin(θ) * circle + [0, 0, outward * np.cos(θ)] for θ in polar]
    rings = np.stack(rings) @ to_world[:3, :3].T + to_world[:3, 3]
    a, b, c, d = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    return np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
