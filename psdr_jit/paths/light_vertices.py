"""Memory for the vertices of light subpaths."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.surface_code import surface_code
from ..core.varying import varying


@dataclass
class LightVertex:
    """A vertex of a light subpath, enough to find it again."""

    x: mi.Point3f
    shape: mi.UInt32  # its `surface_code`
    prim_index: mi.UInt32
    prim_uv: mi.Point2f
    delta: mi.Bool  # left by a delta lobe, away from the light


class LightVertices:
    """Memory for the vertices of `lanes` light subpaths, vertex-major. A plain class: never loop state."""

    BYTES = 4 * 7 + 1  # of one vertex

    def __init__(self, lanes: int, depth: int):
        size = lanes * depth
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        types = (mi.Point3f, mi.UInt32, mi.UInt32, mi.Point2f, mi.Bool)
        self.data = LightVertex(*(dr.empty(kind, size) for kind in types))

    def write(self, k: mi.UInt32, si: mi.SurfaceInteraction3f, pi, delta: mi.Bool, active: mi.Bool) -> None:
        uv = mi.Point2f(pi.prim_uv)
        vertex = LightVertex(si.p, surface_code(pi), mi.UInt32(pi.prim_index), uv, mi.Bool(delta))
        dr.scatter(self.data, vertex, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def read(self, k: mi.UInt32, lane: mi.UInt32, active: mi.Bool) -> LightVertex:
        return dr.gather(LightVertex, self.data, k * self.stride + lane, active)
