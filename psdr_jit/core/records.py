"""In-kernel records: what one stage hands to the next. All are PyTrees of Dr.Jit arrays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Hit:
    """A ray and what it met, compact enough to be stored (the surface point follows from it).

    `shape` is 0 where the ray escaped. Detached.
    """

    o: mi.Point3f  # ray origin, already offset from its surface [m]
    d: mi.Vector3f  # unit direction of travel, away from the sensor
    t: mi.Float  # distance to the surface [m]
    shape: mi.UInt32  # registry index of the shape
    prim_index: mi.UInt32
    prim_uv: mi.Point2f

    @staticmethod
    def of(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> Hit:
        valid = pi.is_valid()
        return Hit(
            o=mi.Point3f(ray.o),
            d=mi.Vector3f(ray.d),
            t=mi.Float(pi.t),
            shape=dr.select(valid, dr.reinterpret_array(mi.UInt32, pi.shape), 0),
            prim_index=mi.UInt32(pi.prim_index),
            prim_uv=mi.Point2f(pi.prim_uv),
        )

    @staticmethod
    def made(make, size: int) -> Hit:
        """`size` hits by `make` (`dr.zeros`, `dr.empty`); typed here, as annotations are resolved once per process."""
        return Hit(
            o=make(mi.Point3f, size),
            d=make(mi.Vector3f, size),
            t=make(mi.Float, size),
            shape=make(mi.UInt32, size),
            prim_index=make(mi.UInt32, size),
            prim_uv=make(mi.Point2f, size),
        )

    def intersection(self) -> mi.PreliminaryIntersection3f:
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = self.shape != 0
        pi.t = dr.select(pi.valid, self.t, dr.inf)
        pi.shape = dr.reinterpret_array(mi.ShapePtr, self.shape)
        pi.prim_index = self.prim_index
        pi.prim_uv = self.prim_uv
        return pi


@dataclass
class EmitterSample:
    """One next-event estimate: which emitter, where on it, and what the estimate is divided by. Detached."""

    emitter: mi.UInt32  # registry index, 0: none sampled, or occluded
    shape: mi.UInt32  # where the shadow ray ended: shape (0 unless an area light) ...
    prim_index: mi.UInt32  # ... primitive ...
    prim_uv: mi.Point2f  # ... and position on it
    d: mi.Vector3f  # unit direction from the vertex to the emitter
    t: mi.Float  # distance [m]
    weight: mi.Float  # MIS / pdf; pdf in 1/sr, or the emitter's pmf if it is delta

    def hit(self, o: mi.Point3f) -> Hit:
        """The shadow ray as if it had started at the vertex `o` itself."""
        return Hit(o, self.d, self.t, self.shape, self.prim_index, self.prim_uv)


@dataclass
class Vertex:
    """What happened at one path vertex; enough to evaluate its terms again without tracing a ray."""

    hit: Hit  # the ray that arrived here
    β: mi.Spectrum  # throughput before this vertex
    weight_emission: mi.Float  # MIS weight of the emission met here by BSDF sampling
    nee: EmitterSample
    inv_pdf: mi.Float  # 1/(pdf · roulette) of the continuation, 0 where the path ended, negated for a delta lobe


@dataclass
class Arrival:
    """The part of a `Vertex` that its predecessor needs: how the sampled direction went on."""

    hit: Hit
    β: mi.Spectrum
    weight_emission: mi.Float
