"""One detached light-transport walk, used by every term: emitter sampling, BSDF sampling, MIS, Russian roulette.

The walk is Mitsuba's `path` (same densities, same power heuristic); it can leave a record of each vertex.
Everything here is detached: derivatives are attached later, from the records (`interior/sweeps.py`) or not at all
(`boundary/`, whose radiances are primal quantities).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import EmitterSample, Hit, Vertex
from .scattering import accepted, mixture_pdf, sample_scattering

#: Relative shortening of a shadow ray, as in Mitsuba's `Interaction::spawn_ray_to` (`math::ShadowEpsilon`).
SHADOW_EPSILON = 1e-3


@dataclass(frozen=True)
class PathLimits:
    """Depths as in Mitsuba's `path`: `max_depth` counts segments, roulette starts at `rr_depth`."""

    max_depth: int
    rr_depth: int
    end_black: bool = True  # a throughput of 0 ends the path; not if its derivative is wanted
    uniform_share: float = 0.0  # of the directions, see `scattering`
    refuses: bool = False  # some BSDF refuses directions it has sampled, and black paths go on: see `scattering`
    own_frames: bool = False  # some BSDF sees how its frame is turned about the normal: see `interaction`


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic a²/(a²+b²) [Veach 1997, §9.2.4], 0 where undefined. Detached."""
    a2, b2 = dr.square(pdf_a), dr.square(pdf_b)
    w = a2 / (a2 + b2)
    return dr.detach(dr.select(dr.isfinite(w), w, 0))


def shadow_test(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool):
    """Is the emitter sample visible from `si`? Any-hit ray; returns `(hit, visible)` with an empty hit."""
    occluded = scene.ray_test(si.spawn_ray_to(ds.p), active)
    return Hit.made(dr.zeros, 1), active & ~occluded


def shadow_hit(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool):
    """The same with a closest-hit ray, which also tells *which* point of an area light was reached.

    With it the light's own motion can be attached later without another ray. Returns `(hit, visible)`.
    """
    ray = si.spawn_ray_to(ds.p)
    on_surface = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    ray.maxt = dr.select(on_surface, ds.dist * (1 + SHADOW_EPSILON), ray.maxt)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    reached = pi.is_valid() & (pi.t >= ds.dist * (1 - SHADOW_EPSILON)) & (pi.shape.emitter() == ds.emitter)
    return Hit.of(ray, pi), active & dr.select(on_surface, reached, ~pi.is_valid())


@dataclass
class Scatter:
    """Emission and scattering at one vertex, while they are at hand. Detached."""

    si: mi.SurfaceInteraction3f
    arrival: mi.Vector3f  # direction of travel in which the vertex was reached
    bsdf: mi.BSDFPtr
    β: mi.Spectrum  # throughput before the vertex
    emission: mi.Spectrum  # of the vertex itself, times ...
    weight_emission: mi.Float  # ... its MIS weight
    emitter: mi.EmitterPtr  # that is met
    sees_emitter: mi.Bool
    ds: mi.DirectionSample3f  # emitter sample ...
    ω_em: mi.Vector3f  # ... its direction, local ...
    mis_em: mi.Float  # ... MIS weight ...
    value_em: mi.Spectrum  # ... and radiance over density
    goes_on: mi.Bool
    wo: mi.Vector3f  # continuation, local
    delta: mi.Bool
    inv_pdf: mi.Float  # 1/(pdf · roulette) of a smooth lobe
    weight: mi.Spectrum  # factor on the throughput


class NoSink:
    """Receives the vertices of a walk and forgets them."""

    connect = staticmethod(shadow_test)

    def radiance(self, k: mi.UInt32, L: mi.Spectrum, active: mi.Bool) -> None:
        """Radiance so far: everything of at most `k` segments beyond the first vertex."""

    def write(self, k: mi.UInt32, vertex: Vertex, active: mi.Bool) -> None:
        """Store vertex number `k` (0: the first) of every active lane."""

    def scattered(self, k: mi.UInt32, scatter: Scatter, active: mi.Bool) -> None:
        """What scattering at vertex `k` was made of, for whoever needs it at once."""


def continue_path(sampler, β: mi.Spectrum, η: mi.Float, k: mi.UInt32, rr_depth: int, end_black: bool = True):
    """Russian roulette after vertex `k`: `(β / survival, η, survives, 1 / survival)`. Mitsuba's criterion."""
    β_max = dr.max(β)
    survival = dr.select(k + 1 >= rr_depth, dr.minimum(β_max * dr.square(η), 0.95), 1)
    survives = sampler.next_1d() < survival
    if end_black:
        survives &= β_max != 0
    inv_survival = dr.select(survives, dr.rcp(survival), 0)
    return β * inv_survival, η, survives, inv_survival


@dr.syntax
def skip_emitters(scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f):
    """Pass straight through area emitters: the ray restarted behind the last one, and what it meets."""
    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array comparison)
    while dr.hint(active, label="psdr.skip_emitters"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
        rest = ray.maxt - pi.t
        ray = si.spawn_ray(ray.d)
        ray.maxt = rest
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        active &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return ray, pi


def first_hit(scene: mi.Scene, ray: mi.Ray3f, hide_emitters: bool):
    """First vertex seen by a camera ray: `(ray, pi, emission)`, `emission` = lanes that count what it emits."""
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    if not hide_emitters:
        return ray, pi, mi.Bool(True)
    ray, pi = skip_emitters(scene, ray, pi)
    return ray, pi, mi.Bool(False)


def interaction(pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, own_frames: bool) -> mi.SurfaceInteraction3f:
    """The surface that `ray` meets. Unless `own_frames`, its shading frame depends on the normal alone.

    Mitsuba takes the tangents of a mesh without texture coordinates from the first side of each triangle: with equal
    random numbers, a path would go on in another direction from the next triangle of the same plane, and the difference
    of radiance across their edge, which is nearly 0, would be noise.
    """
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    if own_frames:
        return si
    si.sh_frame = mi.Frame3f(si.sh_frame.n)
    si.wi = dr.select(si.is_valid(), si.to_local(-ray.d), si.wi)
    return si


def _evaluate_and_sample(
    ctx, si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, sampler, share: float, refuses: bool, active: mi.Bool
):
    """The BSDF towards an emitter and a direction to go on: `(f cosθ, pdf, Scattering)`."""
    u_lobe, u = sampler.next_1d(), sampler.next_2d()
    if share == 0:  # in one virtual call
        f, pdf, bs, weight = bsdf.eval_pdf_sample(ctx, si, wo, u_lobe, u, active)
        return f, pdf, accepted(ctx, si, bsdf, bs, weight, refuses, active)
    f, pdf = bsdf.eval_pdf(ctx, si, wo, active)
    onward = sample_scattering(ctx, si, bsdf, u_lobe, u, share, refuses, active)
    return f, mixture_pdf(si, bsdf, wo, pdf, share), onward


@dr.syntax
def walk(
    scene: mi.Scene,
    sampler,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    limits: PathLimits,
    sink,
    emission: mi.Bool,
    active: mi.Bool,
):
    """Radiance that arrives along `ray`, which meets `pi`; every vertex is handed to `sink`.

    `emission` masks the lanes that count what the first vertex emits. Returns `(L, vertices, scattered)`: the
    radiance estimate, the number of vertices visited, and whether the first vertex was a surface (for alpha).
    Detached throughout; estimator: Kajiya's path tracing with MIS [Veach 1997, §10.3].
    """
    # a frozen dataclass cannot be loop state
    max_depth, rr_depth, end_black = limits.max_depth, limits.rr_depth, limits.end_black
    share, refuses, own_frames = limits.uniform_share, limits.refuses, limits.own_frames
    ctx = mi.BSDFContext()

    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = mi.Bool(active)
    emission = mi.Bool(emission)
    L = mi.Spectrum(0)
    β = mi.Spectrum(1)
    η = mi.Float(1)  # Russian roulette must not see the radiance compression at refraction
    k = mi.UInt32(0)
    prev = dr.zeros(mi.Interaction3f)
    prev_pdf = mi.Float(1)
    prev_delta = mi.Bool(True)
    surface = pi.is_valid()

    while dr.hint(active, label="psdr.walk"):
        si = interaction(pi, ray, own_frames)

        ds = mi.DirectionSample3f(scene, si=si, ref=prev)
        pdf_em = scene.pdf_emitter_direction(prev, ds, ~prev_delta)
        weight_emission = dr.select(emission, mis_weight(prev_pdf, pdf_em), 0)
        met = ds.emitter
        L_here = weight_emission * met.eval(si, emission)
        L += β * L_here

        sink.radiance(k, L, active)

        alive = si.is_valid() & (k + 1 < max_depth)
        bsdf = si.bsdf()
        active_em = alive & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, value_em = scene.sample_emitter_direction(si, sampler.next_2d(), False, active_em)
        hit_em, active_em = sink.connect(scene, si, ds, active_em & (ds.pdf > 0))
        ω_em = si.to_local(ds.d)
        f_em, pdf_bsdf, bs = _evaluate_and_sample(ctx, si, bsdf, ω_em, sampler, share, refuses, alive)
        mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf_bsdf))
        L[active_em] += β * mis_em * f_em * value_em

        β_next, η, survives, inv_survival = continue_path(sampler, β * bs.weight, η * bs.η, k, rr_depth, end_black)
        alive &= survives & (bs.pdf > 0)

        sink.write(
            k,
            Vertex(
                hit=Hit.of(ray, pi),
                β=β,
                weight_emission=weight_emission,
                nee=EmitterSample(
                    emitter=dr.select(active_em, dr.reinterpret_array(mi.UInt32, ds.emitter), 0),
                    shape=hit_em.shape,
                    prim_index=hit_em.prim_index,
                    prim_uv=hit_em.prim_uv,
                    d=ds.d,  # of the vertex itself: the shadow ray starts a little off it
                    t=ds.dist,
                    weight=dr.select(active_em, mis_em / ds.pdf, 0),
                ),
                inv_pdf=dr.select(alive, dr.select(bs.delta, -inv_survival, inv_survival) / bs.pdf, 0),
            ),
            active,
        )

        sink.scattered(
            k,
            Scatter(
                si=si,
                arrival=ray.d,
                bsdf=bsdf,
                β=β,
                emission=L_here,
                weight_emission=weight_emission,
                emitter=met,
                sees_emitter=active_em,
                ds=ds,
                ω_em=ω_em,
                mis_em=mis_em,
                value_em=value_em,
                goes_on=alive,
                wo=bs.wo,
                delta=bs.delta,
                inv_pdf=inv_survival / bs.pdf,
                weight=bs.weight * inv_survival,
            ),
            active,
        )

        β = β_next
        prev = mi.Interaction3f(si)
        prev_pdf = mi.Float(bs.pdf)
        prev_delta = mi.Bool(bs.delta)
        emission = mi.Bool(True)
        k += 1
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=alive)
        active = alive

    return L, k, surface
