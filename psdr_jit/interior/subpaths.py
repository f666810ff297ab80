"""Vertices of light subpaths that were kept, found again lane by lane."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..paths.light_vertices import LightVertex, LightVertices


class Subpaths:
    """Vertices of the subpaths that were kept. A plain class: never loop state."""

    def __init__(self, vertices: LightVertices, lane: mi.UInt32):
        self.vertices, self.lane = vertices, lane

    def vertex(self, k: mi.UInt32, active: mi.Bool) -> LightVertex:
        """Vertex number `k` from the light."""
        return self.vertices.read(k, self.lane, active)


def met_from(o: mi.Point3f, v: LightVertex) -> Hit:
    """The vertex as the end of a ray from `o`."""
    offset = v.x - o
    t = dr.norm(offset)
    return Hit(mi.Point3f(o), mi.Vector3f(offset / t), t, v.shape, v.prim_index, v.prim_uv)
