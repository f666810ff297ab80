"""Paths that light subpaths have found, written down as the camera meets them (`light_traced.py`).

In a record, vertex k has a density p_k by which f_k is divided. Here that is any positive number: the mean of F_k, so
that throughputs stay near 1. The last vertex has the light as its emitter sample, with the factor w V / (Π_k p_k)
that makes the record's radiance that of the path,

    Π_{k<s} (F_k/p_k) · F_s L_e · (scale Π_{k<s} p_k) = scale · L_e Π F_k.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Continuation, EmitterSample, Hit, Vertex
from ..core.sensor_frame import look_at
from ..paths.bounce import PathLimits
from ..paths.delta_step import delta_step
from ..paths.edge_on import GRAZING, GRAZING_FLAT, first_cosine, met_edge_on
from ..paths.light_source import LightStart, is_far
from ..paths.light_technique import average
from ..paths.light_walk import LightPath
from ..paths.rays import interaction, shadow_hit
from ..paths.recording import PathRecords
from ..plan.job import Job
from .subpaths import Subpaths, met_from


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
