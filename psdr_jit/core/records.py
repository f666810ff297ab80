"""In-kernel records: what one stage hands to the next. All are PyTrees of Dr.Jit arrays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .surface_code import set_surface, surface_code


@dataclass
class Hit:
    """A ray and what it met, compact enough to be stored (the surface point follows from it).

    `shape` is 0 where the ray escaped. Detached.
    """

    o: mi.Point3f  # ray origin, already offset from its surface [m]
    d: mi.Vector3f  # unit direction of travel, away from the sensor
    t: mi.Float  # distance to the surface [m]
    shape: mi.UInt32  # its `surface_code`
    prim_index: mi.UInt32
    prim_uv: mi.Point2f

    @staticmethod
    def of(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> Hit:
        return Hit(
            o=mi.Point3f(ray.o),
            d=mi.Vector3f(ray.d),
            t=mi.Float(pi.t),
            shape=surface_code(pi),
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
        set_surface(pi, self.shape)
        pi.prim_index = self.prim_index
        pi.prim_uv = self.prim_uv
        return pi

    def interaction(self, active: mi.Bool | bool = True, flags=mi.RayFlags.All) -> mi.SurfaceInteraction3f:
        """The surface that the ray met. Detached, unless `flags` follow the shape."""
        return self.intersection().compute_surface_interaction(mi.Ray3f(self.o, self.d), flags, active)


@dataclass
class EmitterSample:
    """One next-event estimate: which emitter, where on it, and how likely. Detached."""

    emitter: mi.UInt32  # registry index, 0: none sampled, or occluded
    shape: mi.UInt32  # where the shadow ray ended: `surface_code` (0 unless an area light) ...
    prim_index: mi.UInt32  # ... primitive ...
    prim_uv: mi.Point2f  # ... and position on it
    d: mi.Vector3f  # unit direction from the vertex to the emitter
    t: mi.Float  # distance [m]
    pdf: mi.Float  # per solid angle [1/sr]; of a delta emitter, the probability of choosing it
    mis: mi.Float  # weight against BSDF sampling
    delta: mi.Bool  # a point or a single direction

    @staticmethod
    def made(make, size: int) -> EmitterSample:
        """`size` samples by `make`, see `Hit.made`."""
        return EmitterSample(
            emitter=make(mi.UInt32, size),
            shape=make(mi.UInt32, size),
            prim_index=make(mi.UInt32, size),
            prim_uv=make(mi.Point2f, size),
            d=make(mi.Vector3f, size),
            t=make(mi.Float, size),
            pdf=make(mi.Float, size),
            mis=make(mi.Float, size),
            delta=make(mi.Bool, size),
        )

    def hit(self, o: mi.Point3f) -> Hit:
        """The shadow ray as if it had started at the vertex `o` itself."""
        return Hit(o, self.d, self.t, self.shape, self.prim_index, self.prim_uv)

    def mis_over_pdf(self) -> mi.Float:
        """Factor of the estimate, 0 where there is none. Masked here: a derivative of 0 times infinity is none."""
        return dr.select(self.emitter != 0, self.mis / self.pdf, 0)


@dataclass
class Continuation:
    """How likely a path was to go on as it did. Detached."""

    pdf: mi.Float  # of the direction, per solid angle [1/sr]; of a delta lobe, its probability; 0: the path ended
    survival: mi.Float  # probability that the roulette lets it live
    delta: mi.Bool  # a delta lobe

    @staticmethod
    def made(make, size: int) -> Continuation:
        """`size` of them by `make`, see `Hit.made`."""
        return Continuation(make(mi.Float, size), make(mi.Float, size), make(mi.Bool, size))

    def goes_on(self) -> mi.Bool:
        return self.pdf > 0

    def inv_pdf(self) -> mi.Float:
        """1 / (pdf · survival), 0 where the path ended."""
        return dr.select(self.goes_on(), dr.rcp(self.survival) / self.pdf, 0)


@dataclass
class Vertex:
    """What happened at one path vertex; enough to evaluate its terms again without tracing a ray."""

    hit: Hit  # the ray that arrived here
    β: mi.Spectrum  # throughput before this vertex
    weight_emission: mi.Float  # MIS weight of the emission met here by BSDF sampling
    nee: EmitterSample
    onward: Continuation

    @staticmethod
    def made(make, size: int) -> Vertex:
        """`size` vertices by `make`, see `Hit.made`."""
        return Vertex(
            hit=Hit.made(make, size),
            β=make(mi.Spectrum, size),
            weight_emission=make(mi.Float, size),
            nee=EmitterSample.made(make, size),
            onward=Continuation.made(make, size),
        )


@dataclass
class Place:
    """A vertex among those of its path."""

    first: mi.Bool
    slides: mi.Bool  # in the material and the mixed form: it slides along the ray that reaches it
    slides_next: mi.Bool | None  # so does the one after it; None: in no lane


@dataclass
class Arrival:
    """The part of a `Vertex` that its predecessor needs: how the sampled direction went on."""

    hit: Hit
    β: mi.Spectrum
    weight_emission: mi.Float
    mirrored: mi.Bool  # the path leaves its first vertex by a delta lobe
