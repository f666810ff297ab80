"""What a walk hands over, and when: the contract between `walk.walk` and whoever wants to know about its vertices.

For every vertex k of a lane the walk calls, in this order,

    radiance(k, L, active)        when the vertex has been reached and its emission is part of L
    connect(scene, si, ds, ...)   to ask whether its emitter sample is visible
    scattered(k, scatter, active) when it is known how the path goes on, or that it ends

A sink that is a PyTree (a dataclass of arrays) is part of the loop's state and may add up; one that writes to memory
must not be one, or Dr.Jit takes its buffers for loop state. Everything handed over is detached.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import EmitterSample, Hit, Vertex
from .bounce import Bounce, PathLimits
from .rays import shadow_test
from .scattering import reverse_pdf


@dataclass
class Emission:
    """What a vertex emits towards the one before it."""

    emitter: mi.EmitterPtr
    value: mi.Spectrum  # radiance
    mis: mi.Float  # weight against emitter sampling, 0 where it does not count


@dataclass
class NextEvent:
    """The emitter sample of a vertex."""

    ds: mi.DirectionSample3f  # with its density `ds.pdf`, and `ds.delta`
    ω: mi.Vector3f  # direction, local
    hit: Hit  # where the shadow ray ended, as far as the sink's `connect` tells
    seen: mi.Bool  # sampled and not occluded
    value: mi.Spectrum  # radiance / ds.pdf, as Mitsuba's emitters return it
    f: mi.Spectrum  # BSDF · cosθ
    mis: mi.Float  # weight against BSDF sampling

    def record(self) -> EmitterSample:
        return EmitterSample(
            emitter=dr.select(self.seen, dr.reinterpret_array(mi.UInt32, self.ds.emitter), 0),
            shape=self.hit.shape,
            prim_index=self.hit.prim_index,
            prim_uv=self.hit.prim_uv,
            d=self.ds.d,  # of the vertex itself: the shadow ray starts a little off it
            t=self.ds.dist,
            pdf=self.ds.pdf,
            mis=self.mis,
            delta=self.ds.delta,
        )


@dataclass
class Scatter:
    """One vertex while everything about it is at hand."""

    hit: Hit  # the ray that arrived
    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    β: mi.Spectrum  # throughput before the vertex
    met: Emission
    nee: NextEvent
    onward: Bounce
    limits: PathLimits  # of the walk

    def record(self) -> Vertex:
        """What is enough to evaluate the vertex again without tracing a ray."""
        return Vertex(self.hit, self.β, self.met.mis, self.nee.record(), self.onward.likelihood())

    def pdf_reverse(self) -> mi.Float:
        """Density per solid angle with which a path that comes the other way goes on to the vertex before this one.

        Partner of `onward.scattering.pdf`: both directions exchanged, importance for radiance. 0 for a delta lobe and
        where the path ends.
        """
        s = self.onward.scattering
        active = self.onward.alive & ~s.delta
        pdf = reverse_pdf(mi.BSDFContext(), self.si, self.bsdf, s.wo, self.limits.mixture, active)
        return dr.select(active, pdf, 0)


class Sink(ABC):
    """Receives the vertices of a walk."""

    @abstractmethod
    def radiance(self, k: mi.UInt32, L: mi.Spectrum, active: mi.Bool) -> None:
        """Radiance so far: everything of at most `k` segments beyond the first vertex."""

    @abstractmethod
    def connect(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool
    ) -> tuple[Hit, mi.Bool]:
        """Is the emitter sample visible: `rays.shadow_test`, or `rays.shadow_hit` if its point is to be known."""

    @abstractmethod
    def scattered(self, k: mi.UInt32, scatter: Scatter, active: mi.Bool) -> None:
        """Vertex number `k` (0: the first) of every active lane, the last one of a path included."""


class NoSink(Sink):
    """Forgets them all."""

    def radiance(self, k: mi.UInt32, L: mi.Spectrum, active: mi.Bool) -> None:
        """Not needed."""

    def connect(self, scene, si, ds, active) -> tuple[Hit, mi.Bool]:
        return shadow_test(scene, si, ds, active)

    def scattered(self, k: mi.UInt32, scatter: Scatter, active: mi.Bool) -> None:
        """Not needed."""
