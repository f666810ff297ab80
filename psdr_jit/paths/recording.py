"""Memory for the vertices of a wavefront of paths, so that derivatives can be taken without tracing again."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, Hit, Place, Vertex
from ..core.varying import varying
from .close_by import CloseBy
from .edge_on import GRAZING, met_edge_on
from .rays import shadow_hit
from .sink import NoSink, Scatter, Sink


class PathRecords(Sink):
    """Vertices of `lanes` paths, at most `depth` each, vertex-major (`k * lanes + lane`) so that lanes coalesce.

    A plain class on purpose: Dr.Jit must not take the buffers for loop state. Costs `BYTES_RGB` per vertex.
    `first_cos`: see `edge_on.first_cosine`.
    """

    BYTES_RGB = 4 * (11 + 3 + 1 + 11 + 2) + 2

    def __init__(self, lanes: int, depth: int, first_cos: float = GRAZING):
        self.lanes, self.depth, self.first_cos = lanes, depth, first_cos
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.count = mi.UInt32(0)  # vertices stored, per lane; set by whoever ran the walk
        self.whole = dr.full(mi.UInt32, 0xFFFFFFFF, lanes)  # vertices before the first that is met edge-on
        dr.make_opaque(self.whole)
        self.wavelengths = mi.Color0f()  # per lane, likewise (empty in RGB)
        self.vertices = Vertex.made(dr.empty, lanes * depth)
        self.close_by: mi.Bool | None = None  # by vertex: does the one after it slide (mixed form)?

    def radiance(self, k: mi.UInt32, L: mi.Spectrum, active: mi.Bool) -> None:
        """Not needed: the sweeps add up radiance themselves."""

    def connect(self, scene, si, ds, active) -> tuple[Hit, mi.Bool]:
        return shadow_hit(scene, si, ds, active)

    def scattered(self, k: mi.UInt32, scatter: Scatter, active: mi.Bool) -> None:
        """Store the vertex. Where it is met edge-on the record ends: how it slides, single precision cannot tell."""
        index = k * self.stride + self.lane
        dr.scatter(self.vertices, scatter.record(), index, active, mode=dr.ReduceMode.Permute)
        triangles = dr.select(k == 0, self.first_cos, GRAZING)
        edge_on = active & scatter.si.is_valid() & met_edge_on(scatter.si, scatter.hit.d, triangles)
        # every lane has its own entry; any other mode would compile a kernel for every number of lanes
        mode = dr.ReduceMode.NoConflicts
        dr.scatter_reduce(dr.ReduceOp.Min, self.whole, k, self.lane, edge_on, mode=mode)

    def cut(self) -> mi.Bool:
        """Leave out what the walk has met edge-on; returns the lanes of which something was left out."""
        short = self.whole < self.count
        self.count = dr.minimum(self.count, self.whole)
        return short

    def scattering(self) -> mi.UInt32:
        """Number of vertices per lane without a last one that sends nothing back, but for what it emits."""
        last, ends = self.count - 1, self.count > 1
        index = last * self.stride + self.lane
        v = self.vertices
        lit = dr.gather(mi.UInt32, v.nee.emitter, index, ends) != 0
        goes_on = dr.gather(mi.Float, v.onward.pdf, index, ends) > 0
        return dr.select(ends & ~lit & ~goes_on, last, self.count)

    def vertex(self, k: mi.UInt32, active: mi.Bool) -> Vertex:
        """Vertex `k` of every lane; zero where inactive."""
        return dr.gather(Vertex, self.vertices, k * self.stride + self.lane, active)

    def note_close_by(self, close_by: CloseBy) -> None:
        """Ask of every vertex whether another surface is close by, where the path goes on."""
        entry = dr.arange(mi.UInt32, self.lanes * self.depth)
        k, count = entry // self.stride, dr.gather(mi.UInt32, self.count, entry % self.stride)
        goes_on = (k < count) & self.vertices.onward.goes_on()
        onward = dr.gather(mi.Vector3f, self.vertices.hit.d, entry + self.stride, goes_on)
        hit = self.vertices.hit
        self.close_by = close_by.met_by(mi.Ray3f(hit.o, hit.d), hit.intersection(), onward, goes_on)
        dr.eval(self.close_by)

    def place(self, k: mi.UInt32, active: mi.Bool) -> Place:
        """Vertex `k` of every lane among those of its path."""
        first = k == 0
        if self.close_by is None:
            return Place(first, first, None)
        index = k * self.stride + self.lane
        before = dr.gather(mi.Bool, self.close_by, index - self.stride, active & ~first)
        return Place(first, first | before, dr.gather(mi.Bool, self.close_by, index, active))

    def arrival(self, k: mi.UInt32, active: mi.Bool) -> Arrival:
        """Only how vertex `k` was reached, and what its emission counts."""
        index = k * self.stride + self.lane
        v = self.vertices
        return Arrival(
            hit=dr.gather(Hit, v.hit, index, active),
            β=dr.gather(mi.Spectrum, v.β, index, active),
            weight_emission=dr.gather(mi.Float, v.weight_emission, index, active),
            mirrored=dr.gather(mi.Bool, v.onward.delta, self.lane, active),
        )


class RadianceByDepth(NoSink):
    """Keeps the radiance of every path length, so that a subpath in front of it can use what its depth leaves."""

    def __init__(self, lanes: int, depth: int):
        self.lanes, self.depth = lanes, depth
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.values = dr.zeros(mi.Spectrum, lanes * depth)
        self.reached = dr.zeros(mi.UInt32, lanes)  # entries written, per lane
        dr.make_opaque(self.values, self.reached)

    def radiance(self, k: mi.UInt32, L: mi.Spectrum, active: mi.Bool) -> None:
        dr.scatter(self.values, L, k * self.stride + self.lane, active)
        dr.scatter(self.reached, k + 1, self.lane, active)

    def up_to(self, k: mi.UInt32, lane: mi.UInt32, final: mi.Spectrum) -> mi.Spectrum:
        """Radiance of `lane` with at most `k` segments beyond the first vertex; `final`: of the whole path."""
        stored = k < dr.gather(mi.UInt32, self.reached, lane)
        value = dr.gather(mi.Spectrum, self.values, k * self.stride + lane, stored)
        return dr.select(stored, value, final)
