"""One detached light-transport walk, used by every term: emitter sampling, BSDF sampling, MIS, Russian roulette.

The walk is Mitsuba's `path` (same densities, same power heuristic); what happens at each vertex is handed to a `Sink`.
Two walks from beside an edge have random numbers in common, so that noise cancels in their difference. The outline of a
mirror or of a ball of glass is met edge-on and passes the light straight on: both walks then meet the same surfaces,
but one of them a vertex later. With `limits.aligned`, vertices of delta lobes alone draw numbers of their own and leave
those of all others as they are. With `limits.edge_on`, first vertices on outlines are seen as the limit shows them.

Everything here is detached: derivatives are attached later, from records (`interior/sweeps.py`) or not at all
(`boundary/`, whose radiances are primal quantities).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from .bounce import Bounce, PathLimits, PathState, evaluate_and_bounce
from .light_technique import Trail
from .rays import SHADOW_EPSILON, first_hit, interaction, see_through_emitters, skip_emitters
from .sink import Emission, NextEvent, NoSink, Scatter, Sink

#: All that a caller of the walk needs.
__all__ = [
    "SHADOW_EPSILON",
    "NoSink",
    "PathLimits",
    "first_hit",
    "mis_weight",
    "see_through_emitters",
    "skip_emitters",
    "walk",
]


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic a²/(a²+b²) [Veach 1997, §9.2.4], 0 where undefined. Detached."""
    a2, b2 = dr.square(pdf_a), dr.square(pdf_b)
    w = a2 / (a2 + b2)
    return dr.detach(dr.select(dr.isfinite(w), w, 0))


@dataclass
class _Departure:
    """Where an arriving ray has set out and how likely it was: for the MIS weight of the emission that it meets."""

    it: mi.Interaction3f
    pdf: mi.Float
    delta: mi.Bool  # by a delta lobe, or from the sensor: no emitter sample could have found the same path
    trail: Trail | None  # how likely light subpaths are to find the same, where there are any

    @staticmethod
    def of_first_ray(limits: PathLimits) -> _Departure:
        trail = None if limits.light is None else limits.light.start()
        return _Departure(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True), trail)

    def on_from(self, k: mi.UInt32, si, bsdf: mi.BSDFPtr, onward: Bounce, limits: PathLimits) -> _Departure:
        """The departure from `si`, the vertex number `k`."""
        s, trail = onward.scattering, self.trail
        if limits.light is not None:
            trail = limits.light.carry_on(trail, k, si, bsdf, s, onward.alive)
        return _Departure(mi.Interaction3f(si), mi.Float(s.pdf), mi.Bool(s.delta), trail)


def _emission(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    last: _Departure,
    k: mi.UInt32,
    limits: PathLimits,
    counts: mi.Bool,
) -> Emission:
    """What the vertex number `k` emits; `counts`: lanes that want to know."""
    ds = mi.DirectionSample3f(scene, si=si, ref=last.it)
    pdf_em = scene.pdf_emitter_direction(last.it, ds, ~last.delta)
    mis = dr.select(counts, mis_weight(last.pdf, pdf_em), 0)
    if limits.light is not None:
        mis = limits.light.share_emission(mis, last.trail, k, last.it.p, si, ds.emitter)
    return Emission(ds.emitter, ds.emitter.eval(si, counts), mis)


def _scatter(
    scene: mi.Scene,
    sampler,
    si: mi.SurfaceInteraction3f,
    path: PathState,
    last: _Departure,
    limits: PathLimits,
    sink: Sink,
    active: mi.Bool,
) -> tuple[NextEvent, Bounce]:
    """Sample an emitter, and a direction to go on."""
    bsdf = si.bsdf()
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, value = scene.sample_emitter_direction(si, sampler.next_2d(), False, smooth)
    hit, seen = sink.connect(scene, si, ds, smooth & (ds.pdf > 0))
    ω = si.to_local(ds.d)
    f, pdf, onward = evaluate_and_bounce(si, bsdf, ω, sampler, path, limits, active)
    mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
    if limits.light is not None:
        mis = limits.light.share_next_event(mis, last.trail, path.k, si, bsdf, ω, ds, seen)
    return NextEvent(ds, ω, hit, seen, value, f, mis), onward


@dr.syntax
def walk(
    scene: mi.Scene,
    sampler,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    limits: PathLimits,
    sink: Sink,
    emission: mi.Bool,
    active: mi.Bool,
):
    """Radiance that arrives along `ray`, which meets `pi`; every vertex is handed to `sink`.

    `emission` masks the lanes that count what the first vertex emits. Returns `(L, vertices, scattered)`: the
    radiance estimate, the number of vertices visited, and whether the first vertex was a surface (for alpha).
    Detached throughout; estimator: Kajiya's path tracing with MIS [Veach 1997, §10.3].
    """
    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = mi.Bool(active)
    emission = mi.Bool(emission)
    L = mi.Spectrum(0)
    path = PathState.start()
    last = _Departure.of_first_ray(limits)
    surface = pi.is_valid()

    # a frozen dataclass cannot be loop state
    while dr.hint(active, label="psdr.walk", exclude=[limits]):
        si = interaction(pi, ray, limits)
        if dr.hint(limits.edge_on is not None, mode="scalar"):
            si = limits.edge_on.at_limit(si, ray.d, active & (path.k == 0))
        met = _emission(scene, si, last, path.k, limits, emission)
        L += path.β * (met.mis * met.value)
        sink.radiance(path.k, L, active)

        bsdf = si.bsdf()
        inside = si.is_valid() & (path.k + 1 < limits.max_depth)
        here = sampler
        if dr.hint(limits.aligned, mode="scalar"):
            bends = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            here = sampler.aside(path.k, bends)
        nee, onward = _scatter(scene, here, si, path, last, limits, sink, inside)
        if dr.hint(limits.aligned, mode="scalar"):
            sampler = dr.select(bends, sampler, here)
        L[nee.seen] += path.β * nee.mis * nee.f * nee.value
        sink.scattered(path.k, Scatter(Hit.of(ray, pi), si, bsdf, path.β, met, nee, onward, limits), active)

        last = last.on_from(path.k, si, bsdf, onward, limits)
        path = onward.path
        emission = mi.Bool(True)
        ray = onward.ray(si)
        active = onward.alive
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    return L, path.k, surface
