"""The interior term's paths that light subpaths find: turned around, and differentiated as any other.

How a path is found and how it flows are two things. The derivative of what all techniques find together is

    dI = Σ_t E[ w_t V_t D(x̄) ]

V_t the contribution over the density of technique t, w_t its weight, both detached, D the relative derivative of the
integrand along *our* flow, which is the same for every t. So a path from the light (`paths/light_walk.py`) is written
down as the camera would have met it, and goes through the sweeps (`sweeps.py`) that all paths go through. Its film
point is where the sensor sees x_1 now, and stays fixed while θ changes: the attached camera ray through it moves.

In a record, vertex k has a density p_k by which f_k is divided. Here that is any positive number: the mean of F_k, so
that throughputs stay near 1. The last vertex has the light as its emitter sample, with the factor w V / (Π_k p_k)
that makes the record's radiance that of the path,

    Π_{k<s} (F_k/p_k) · F_s L_e · (scale Π_{k<s} p_k) = scale · L_e Π F_k.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate
from ..core.low_discrepancy import lane_sampler
from ..core.records import Continuation, EmitterSample, Hit, Vertex
from ..core.sensor_frame import look_at
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..paths.bounce import PathLimits
from ..paths.delta_step import delta_step
from ..paths.edge_on import GRAZING, GRAZING_FLAT, first_cosine, met_edge_on
from ..paths.light_source import LightStart, is_far
from ..paths.light_technique import average
from ..paths.light_vertices import LightVertices
from ..paths.light_walk import LightPath, trace_light
from ..paths.rays import interaction, shadow_hit
from ..paths.recording import PathRecords
from ..plan.job import Job
from . import light_borne
from .flow import Flow
from .light_borne import LightBorne
from .subpaths import Subpaths, met_from
from .sweeps import backward_sweep, forward_sweep


@dataclass(frozen=True)
class LightTraced:
    """Paths of one pass that light subpaths have found; host object. `borne`: those that nothing else finds."""

    turned: TurnedPaths | None
    borne: LightBorne | None


@dataclass(frozen=True)
class TurnedPaths:
    """Paths that camera paths find as well."""

    records: PathRecords
    path: LightPath
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths, over the number of subpaths


def find_paths(job: Job, seed: mi.UInt32, spp: int, limits: PathLimits) -> LightTraced | None:
    """Trace the light subpaths that go with `spp` camera samples per pixel; None if none of them reaches the sensor."""
    technique, lanes = limits.light, job.plan.light.subpaths(job.frame, spp)
    rng = lane_sampler(stream_seed(seed, Stream.LIGHT_SUBPATH), dr.arange(mi.UInt32, lanes))
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    start = technique.sources.sample(rng, wavelengths)
    vertices = LightVertices(lanes, technique.longest)
    path = trace_light(job.scene, rng, start, limits, job.options.hide_emitters, vertices)
    found = path.scale > 0
    weight = mi.Spectrum(weight) / varying(mi.Float, lanes)
    dr.eval(path, start, wavelengths, weight, found, vertices.data)
    all_paths = _Found(path, start, wavelengths, weight, vertices)
    turned = _turned(job, all_paths, dr.compress(found & ~path.alone), limits)
    borne = None
    if technique.delta_lobes:
        borne = _borne(job, all_paths, dr.compress(found & path.alone), limits)
    return LightTraced(turned, borne)


@dataclass(frozen=True)
class _Found:
    """What light subpaths brought, all lanes; host object."""

    path: LightPath
    start: LightStart
    wavelengths: mi.Color0f
    weight: mi.Spectrum
    vertices: LightVertices

    def of(self, lane: mi.UInt32) -> tuple[LightPath, LightStart, mi.Color0f, mi.Spectrum]:
        """Path, start, wavelengths and their weight in these lanes."""
        path, start = (dr.gather(type(record), record, lane) for record in (self.path, self.start))
        wavelengths, weight = self.wavelengths, self.weight
        if mi.is_spectral:
            wavelengths, weight = (dr.gather(type(v), v, lane) for v in (wavelengths, weight))
        return path, start, wavelengths, weight


def _borne(job: Job, found: _Found, lane: mi.UInt32, limits: PathLimits) -> LightBorne | None:
    """Paths that only the light finds, as it meets them."""
    if dr.width(lane) == 0:
        return None
    path, start, _, weight = found.of(lane)
    subpaths = Subpaths(found.vertices, lane)
    return light_borne.record(job, path, start, subpaths, limits, path.value * weight, limits.light.longest)


def _turned(job: Job, found: _Found, lane: mi.UInt32, limits: PathLimits) -> TurnedPaths | None:
    """The others, as the camera meets them."""
    if dr.width(lane) == 0:
        return None
    path, start, wavelengths, weight = found.of(lane)
    subpaths = Subpaths(found.vertices, lane)
    # a light that is met behind a delta lobe is a vertex of its own
    records = PathRecords(dr.width(lane), limits.light.longest + (1 if limits.light.delta_lobes else 0))
    sound = turn_around(job, path, start, subpaths, limits, records)
    records.count = dr.select(sound, records.count, 0)
    records.wavelengths = wavelengths
    dr.eval(sound, records.count, records.vertices)  # at once: what is read later would go over the paths again
    if job.facts.geometry_moves:
        job.call.counters.grazing.count(~sound)
    return TurnedPaths(records, path, wavelengths, weight)


@dr.syntax
def turn_around(
    job: Job, path: LightPath, start: LightStart, subpath: Subpaths, limits: PathLimits, records: PathRecords
) -> mi.Bool:
    """Write the paths into `records` in the order in which the camera meets them. Detached.

    Returns the lanes that have a derivative: no vertex is met edge-on (`met_edge_on`), by what comes from the sensor or
    from the light, and the light is where it was.
    """
    n = mi.UInt32(path.count)
    here = subpath.vertex(n - 1, n > 0)
    o = mi.Point3f(look_at(job.frame, here.x, path.aperture).o)
    k = mi.UInt32(0)
    β = mi.Spectrum(1)
    factor = mi.Float(path.scale)
    sound = mi.Bool(n > 0)
    count = mi.UInt32(n)
    active = mi.Bool(n > 0)
    while dr.hint(active, label="psdr.turn_around", exclude=[job, limits, path, start, subpath]):
        hit = met_from(o, here)
        si = interaction(hit.intersection(), mi.Ray3f(o, hit.d, 0, start.ray.wavelengths), limits)
        sound &= ~met_edge_on(si, hit.d, dr.select(k == 0, first_cosine(job.sensor), GRAZING))
        last = k + 1 == n
        following = subpath.vertex(n - 2 - k, active & ~last)
        o = mi.Point3f(si.spawn_ray_to(following.x).o)  # off the surface: a sphere is met again from its inside
        ω = met_from(o, following).d  # as the record of the next vertex has it
        delta = here.delta & (k > 0)  # the first vertex was connected to the sensor
        met = last & delta
        light, hit_light, seen = _emitter_sample(job.scene, start, si, here.x, factor, active & last)
        light.emitter = dr.select(delta, 0, light.emitter)
        sound &= seen | ~last
        ω = dr.select(last, hit_light.d, ω)
        F = _factor(si, ω, delta, limits, active & (~last | delta))
        sound &= last | delta | _differentiable(si, ω, limits)
        # the light meets this vertex along −ω; at the outline of a ball it does so as often as its rays pass there
        sound &= delta | ~met_edge_on(si, ω, GRAZING_FLAT)
        p = average(F)
        p = dr.select(last & ~delta, 0, dr.select(p > 0, p, 1))
        vertex = Vertex(hit, β, mi.Float(0), light, Continuation(p, mi.Float(1), mi.Bool(delta)))
        dr.scatter(records.vertices, vertex, k * records.stride + records.lane, active, mode=dr.ReduceMode.Permute)
        goes_on = ~last | delta
        β = dr.select(goes_on, β * F / p, β)
        factor = dr.select(goes_on, factor * p, factor)
        _write_light(records, hit_light, k + 1, β, factor, active & met)
        count = dr.select(met, n + 1, count)
        here = following
        k += 1
        active = k < n
    records.count = count
    return sound


def _factor(
    si: mi.SurfaceInteraction3f, ω: mi.Vector3f, delta: mi.Bool, limits: PathLimits, active: mi.Bool
) -> mi.Spectrum:
    """F_k of a vertex that is left in the direction ω, by a delta lobe or not."""
    ctx, bsdf = mi.BSDFContext(), si.bsdf()
    F = bsdf.eval(ctx, si, si.to_local(ω), active & ~delta)
    if not limits.light.delta_lobes:
        return F
    return dr.select(delta, delta_step(ctx, si, bsdf, ω, active & delta).value, F)


def _write_light(
    records: PathRecords, hit: Hit, k: mi.UInt32, β: mi.Spectrum, factor: mi.Float, active: mi.Bool
) -> None:
    """The light as vertex `k`, met behind a delta lobe, its emission worth `factor`."""
    ends = Continuation(mi.Float(0), mi.Float(1), mi.Bool(False))
    width = dr.width(β)
    vertex = Vertex(hit, β, factor, EmitterSample.made(dr.zeros, width), ends)
    dr.scatter(records.vertices, vertex, k * records.stride + records.lane, active, mode=dr.ReduceMode.Permute)


def _differentiable(si: mi.SurfaceInteraction3f, ω: mi.Vector3f, limits: PathLimits) -> mi.Bool:
    """Can one tell on which side of the critical angle the turn towards ω is?"""
    if limits.critical is None:
        return mi.Bool(True)
    return ~limits.critical.blurred(si.bsdf(), si.wi, si.to_local(ω))


def _emitter_sample(
    scene: mi.Scene, start: LightStart, si: mi.SurfaceInteraction3f, x: mi.Point3f, factor: mi.Float, active: mi.Bool
) -> tuple[EmitterSample, Hit, mi.Bool]:
    """The light as the emitter sample of `si` (at x), worth `factor`; nowhere else than in `active` lanes."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.dist, ds.d = start.y, dr.norm(start.y - x), -start.ray.d
    ds.emitter = dr.reinterpret_array(mi.EmitterPtr, start.emitter)
    hit, seen = shadow_hit(scene, si, ds, active)
    hit.d = dr.select(is_far(ds.emitter), ds.d, hit.d)
    sample = EmitterSample(
        emitter=dr.select(seen, start.emitter, 0),
        shape=dr.select(active, hit.shape, 0),
        prim_index=hit.prim_index,
        prim_uv=hit.prim_uv,
        d=ds.d,
        t=ds.dist,
        pdf=mi.Float(1),
        mis=factor,
        delta=start.delta,
    )
    return sample, hit, seen


def _splat(job: Job, found: TurnedPaths, values: mi.Spectrum) -> mi.TensorXf:
    """Image of one value per path; attached where `values` are."""
    landed = found.records.count > 0
    return films.develop_boundary(job.film, found.path.p, values * found.weight, mi.Float(0), found.wavelengths, landed)


def _camera_ray(job: Job, found: TurnedPaths) -> mi.Ray3f:
    """The attached camera rays through the fixed film points."""
    ray, _ = job.sensor.sample_ray(0, 0.5, found.path.film, found.path.aperture)
    return ray


def forward(job: Job, found: LightTraced, flow: Flow) -> mi.TensorXf:
    """Derivative image of the paths found. Detached."""
    image = films.black(job.film)
    if found.turned is not None:
        image += _forward(job, found.turned, flow)
    if found.borne is not None:
        image += light_borne.forward(found.borne)
    return image


def backward(job: Job, found: LightTraced, flow: Flow, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ of the paths found into the attached parameters."""
    if found.turned is not None:
        _backward(job, found.turned, flow, grad_in)
    if found.borne is not None:
        light_borne.backward(found.borne, grad_in)


def _forward(job: Job, found: TurnedPaths, flow: Flow) -> mi.TensorXf:
    o_grad, d_grad = mi.Vector3f(0), mi.Vector3f(0)
    if job.facts.camera_moves:
        with dr.resume_grad():
            ray = _camera_ray(job, found)
        o_grad, d_grad = job.motion.camera_tangents(ray)
    dL, _ = forward_sweep(found.records, o_grad, d_grad, flow, job.motion)
    return _splat(job, found, job.call.counters.rejected.keep_finite(dL))


def _backward(job: Job, found: TurnedPaths, flow: Flow, grad_in: mi.TensorXf) -> None:
    with dr.resume_grad():
        values = dr.zeros(mi.Spectrum, found.records.lanes)
        dr.enable_grad(values)
        backpropagate(_splat(job, found, values), grad_in)
        δL = dr.grad(values)
    films.clear(job.film)
    λ_o, λ_d, _ = backward_sweep(found.records, δL, flow, job.motion)
    if job.facts.camera_moves:
        dr.eval(λ_o, λ_d)  # stored, as in `term`: a pose asks for each of them twelve times
        with dr.resume_grad():
            ray = _camera_ray(job, found)
            accumulate(dr.dot(ray.o, λ_o) + dr.dot(ray.d, λ_d))
