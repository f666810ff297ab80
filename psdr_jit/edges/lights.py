"""May a light see an edge as an outline? Conservatively, from the bounds of the light alone.

An edge lies in the planes of its faces, so which face turns to a point depends on the point alone; seen from all
corners of a light's bounding box alike, it is alike from all of the light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from .points import facing
from .rows import EdgeRows

#: Relative distance from a plane within which a point counts as on it.
IN_PLANE = 1e-6


@dataclass(frozen=True)
class LightBounds:
    """Where a light can be."""

    corners: list[mi.Vector4f]  # homogeneous: of its box, or the one direction towards it
    extremes: list[mi.Vector4f]  # those that are lowest and highest in every coordinate
    plane: tuple[mi.Vector3f, mi.Point3f] | None = None  # normal and point of a flat light, which shines to one side


def may_cast_shadow(rows: EdgeRows, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
    """By row: may some light see it as an outline, with something of the scene behind it?"""
    found = mi.Bool(False)
    for light in lights:
        possible = rows.border | rows.traced | _may_be_silhouette(rows, light.corners)
        if light.plane is not None:
            possible &= _in_front(rows, *light.plane)
        found |= possible & ~_leaves_scene(rows, light.extremes, box)
    return found


def _may_be_silhouette(rows: EdgeRows, corners: list[mi.Vector4f]) -> mi.Bool:
    """False where both faces turn to every corner, or both away from every corner."""
    both, neither = mi.Bool(True), mi.Bool(True)
    for c in corners:
        towards = mi.Vector3f(c.x, c.y, c.z) - c.w * mi.Vector3f(rows.p0)
        front0, front1 = facing(rows.n0, towards) > 0, facing(rows.n1, towards) > 0
        both &= front0 & front1
        neither &= ~front0 & ~front1
    return ~(both | neither)


def _leaves_scene(rows: EdgeRows, corners: list[mi.Vector4f], box: mi.ScalarBoundingBox3f) -> mi.Bool:
    """Does the shadow of the edge miss everything, because it starts on the scene's bounding box and leads out?"""
    leaves = mi.Bool(False)
    lower, upper = (varying(mi.Point3f, list(corner)) for corner in (box.min, box.max))
    for axis in range(3):
        for sign, face in ((-1, lower[axis]), (1, upper[axis])):
            margin = IN_PLANE * (dr.abs(face) + upper[axis] - lower[axis])
            outward = (dr.abs(rows.p0[axis] - face) <= margin) & (dr.abs(rows.p1[axis] - face) <= margin)
            for c in corners:
                outward &= sign * (c[axis] - c.w * face) < -margin  # the light is on the inner side
            leaves |= outward
    return leaves


def _in_front(rows: EdgeRows, n: mi.Vector3f, p: mi.Point3f) -> mi.Bool:
    """Does any point of an edge lie on the side to which a flat light shines?"""
    height = dr.maximum(dr.dot(n, rows.p0 - p), dr.dot(n, rows.p1 - p))
    return height > IN_PLANE * (dr.norm(p) + dr.norm(rows.p1 - rows.p0))
