"""Baseline: unidirectional edge sampling, the secondary boundary found from a camera path.

Before boundaries were sampled from the edge outwards, differentiable path tracers looked for them from where the path
happened to be [Li et al. 2018, Differentiable Monte Carlo Ray Tracing through Edge Sampling; Zhang et al. 2019, A
Differential Theory of Radiative Transfer]. `EdgeSampling` does that with our own edge table and our own interior and
primary terms, so that it differs from `psdr_path` in nothing but where the secondary boundary is sampled.

*Derivation.* A camera path x_1, x_2, … by BSDF sampling has throughput β_k at x_k, where

    L_o(x_k) = ∫ f(ω) cosθ L_i(x_k, ω) dω

and L_i jumps across the image of every edge on the sphere of directions. Reynolds' transport theorem [Zhang et al.
2019] leaves an integral over that image, a curve with element |τ×ω| dl / r_B whose points move with s·(v_B − u_k) / r_B
across themselves (s = τ×ω/|τ×ω|, ω from x_k to the edge point x_B, r_B their distance, v_B the edge's velocity, u_k
that of x_k sliding along its ray, see `psdr_jit/interior/sweeps.py`). With one edge point of density pdf_len per
vertex,

    β_k f cosθ (L_− − L_+) s·(v_B − u_k) |τ×ω| / (r_B² pdf_len)

where L_∓ are the radiances from beside the edge on the side −s and +s, with common random numbers and *without* what
the first vertex x_S beyond the edge emits. The interior term has that emission in material form, where an emitter's own
outline does not move; so only what silhouettes hide of it counts, relative to the motion u_S of the emitter's points:

    − β_k f cosθ L_e n·[(v_B − u_k) − (r_B / r_S) (u_S − u_k)] |τ×ω| / (r_B² pdf_len),    n = ±s, to the open side

with r_S = |x_S − x_k|, and r_B / r_S = 0 for an environment. Both are the integrands of `boundary/indirect.py` and
`boundary/direct.py`; only the measure is another: points of the receiver and the edge in place of the edge and a
direction. The 1/r_B² is its weakness, and that the edge is drawn without regard to x_k: most are not seen from there,
are no silhouettes, or do not move against x_k. Nothing aims at the light: silhouettes against a small one are rare.

*Limits.* Straight edges only, forward mode only, no delta lights (whether the line through x_k and x_B ends on one has
probability 0). Li et al. choose edges near x_k more often by a hierarchy; here one distribution, weight length ×
exterior angle, serves the whole scene. With edges by the thousand, theirs is better than this.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from psdr_jit.core import film as films
from psdr_jit.core.ad import tangents
from psdr_jit.core.compaction import compact
from psdr_jit.core.film_samples import FilmSamples
from psdr_jit.core.records import Hit
from psdr_jit.core.streams import Stream, stream_seed
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges.kind import Sight
from psdr_jit.edges.kind_mesh import BetweenFaces
from psdr_jit.edges.rows import EdgeRows
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.edges.table import EdgeTable, look_beside
from psdr_jit.errors import UnsupportedError
from psdr_jit.interior.term import camera_passes
from psdr_jit.paths.bounce import PathState, bounce
from psdr_jit.paths.walk import SHADOW_EPSILON, NoSink, first_hit, walk
from psdr_jit.plan.job import Job
from psdr_jit.sampling.distribution import EdgeDistribution, pmf, sample_edge
from psdr_jit.sampling.rows import WeightedRows
from psdr_jit.scene.facts import SceneFacts

#: Exterior angle that seams without one (split textures or normals) get, so that they are sampled at all [rad].
LEAST_ANGLE = 1e-2


class EdgeSampling:
    """Derivative images with the secondary boundary from camera paths; options as of `psdr_path`.

    `spp`: camera paths per pixel of every term. Each vertex of a path but the last draws one edge point.
    """

    def __init__(self, max_depth: int = -1, rr_depth: int = 5, hide_emitters: bool = False):
        limits = {"max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}
        self._others = mi.load_dict({"type": "psdr_path", "form": "spatial", "sppd": 0, "sppi": 0, **limits})

    @property
    def stats(self) -> dict:
        return self._others.stats

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0) -> mi.TensorXf:
        """Derivative image along the tangents set on the scene's parameters. Detached."""
        jobs = prepare(self._others.call(scene, sensor, seed, spp)).jobs
        for _, job in jobs:
            require_supported(job.facts)
        images = [term.forward(job) for term, job in jobs]
        interior = [job for term, job in jobs if term.name == "interior" and job.facts.geometry_moves]
        images += [secondary_boundary(job) for job in interior]
        if not images:
            return self._others.render_forward(scene, params, sensor, seed, spp)
        return sum(images[1:], images[0])


def require_supported(facts: SceneFacts) -> None:
    """Raise for lights whose shadows this method cannot find."""
    names = [f"'{e.name}' ({e.plugin})" for e in facts.emitters if e.delta]
    if names and facts.geometry_moves:
        raise UnsupportedError(
            f"edge sampling from camera paths cannot find the shadow edges of {', '.join(names)}: that the line "
            "through a path vertex and an edge point meets a point or a single direction has probability 0; use "
            "psdr_path, or an area light"
        )


def scene_distribution(table: EdgeTable) -> EdgeDistribution | None:
    """All straight edges, weight length × exterior angle."""
    if not all(isinstance(kind, BetweenFaces) for kind in table.kinds):
        raise UnsupportedError(
            "edge sampling from camera paths has no outlines of spheres, cylinders and disks, nor of smooth-shaded "
            "meshes, which depend on the viewer; use psdr_path, or flat-shaded meshes in their place"
        )
    return WeightedRows().init("edge sampling", [kind_weights(kind.rows) for kind in table.kinds])


def kind_weights(rows: EdgeRows) -> mi.Float:
    """Length × exterior angle."""
    jumps = rows.seam | rows.border | rows.traced
    angle = dr.maximum(rows.angle, dr.select(jumps, LEAST_ANGLE, 0))
    return dr.norm(rows.p1 - rows.p0) * angle


@dataclass
class CameraPath:
    """How a camera path arrives at its present vertex. Detached, one entry per path that goes on."""

    lane: mi.UInt32
    hit: Hit
    o_grad: mi.Vector3f  # tangents of the ray
    d_grad: mi.Vector3f
    β: mi.Spectrum
    η: mi.Float
    wavelengths: mi.Color0f


@dataclass
class EdgeView:
    """An edge point that a path vertex sees. Detached, one entry per kept sample."""

    lane: mi.UInt32
    sight: Sight  # of x_B from x_k
    v: mi.Vector3f  # velocity of x_B
    u: mi.Vector3f  # that of x_k
    passes: mi.UInt32  # the side on which light passes a silhouette: 0 (−s) or 1 (+s); 2: no silhouette
    weight: mi.Spectrum  # β f cosθ |τ×ω| / (r² pdf)
    wavelengths: mi.Color0f


def secondary_boundary(job: Job) -> mi.TensorXf:
    """Derivative image of direct and indirect boundary together. Detached."""
    image = films.black(job.film)
    with dr.suspend_grad():
        table = scene_edges(job)
        dist = scene_distribution(table)
        if dist is None:
            return image
        for p in camera_passes(job):
            dL = job.call.counters.rejected.keep_finite(along_paths(job, table, dist, p))
            dr.eval(dL)  # the splat below reads it inside a recorded loop, where pending writes are not seen
            image += p.share * films.develop_samples(job.film, p.at, dL * p.weight, p.ray.wavelengths)
    return image


def along_paths(job: Job, table: EdgeTable, dist: EdgeDistribution, p) -> mi.Spectrum:
    """Derivative of the radiance of every camera ray of the pass `p` by its secondary boundaries."""
    dL = dr.zeros(mi.Spectrum, p.samples.count)
    path = first_arrivals(job, p)
    k = 1  # the vertex: x_k
    # one segment is left for the emitter
    while k < job.options.depth_limit and path is not None:
        seed = mi.sample_tea_32(p.seed, mi.UInt32(k))[0]
        si, u = arrive(path)
        view = sample_view(job, table, dist, path, si, u, stream_seed(seed, Stream.INDIRECT_EDGE), p.samples)
        if view is not None:
            rng = stream_seed(seed, Stream.INDIRECT_RADIANCE)
            dr.scatter_add(dL, *across(job, table, view, job.options.depth_limit - k, rng, p.samples))
        if k + 1 < job.options.depth_limit:
            path = go_on(job, path, si, u, k, stream_seed(seed, Stream.INDIRECT_SUBPATH), p.samples)
        k += 1
    return dL


def first_arrivals(job: Job, p) -> CameraPath | None:
    """Camera rays that meet a surface."""
    n = p.samples.count
    o_grad, d_grad = mi.Vector3f(0), mi.Vector3f(0)
    if job.facts.camera_moves:
        with dr.resume_grad():
            o_grad, d_grad = (mi.Vector3f(g) for g in tangents(p.ray.o, p.ray.d))
    start = mi.Ray3f(dr.detach(p.ray))
    ray, pi, _ = first_hit(job.scene, start, job.options.hide_emitters)
    path = CameraPath(
        lane=dr.arange(mi.UInt32, n),
        hit=Hit.of(ray, pi),
        o_grad=o_grad + dr.dot(ray.o - start.o, start.d) * d_grad + dr.zeros(mi.Vector3f, n),
        d_grad=d_grad + dr.zeros(mi.Vector3f, n),
        β=dr.full(mi.Spectrum, 1, n),
        η=dr.full(mi.Float, 1, n),
        wavelengths=ray.wavelengths,
    )
    return compact(path, pi.is_valid())


def arrive(path: CameraPath) -> tuple[mi.SurfaceInteraction3f, mi.Vector3f]:
    """The vertex, and its velocity u_k by motion transport: `(si, u)`, both detached."""
    with dr.resume_grad():
        o, d = mi.Point3f(path.hit.o), mi.Vector3f(path.hit.d)
        dr.enable_grad(o, d)
        dr.set_grad(o, path.o_grad)
        dr.set_grad(d, path.d_grad)
        ray = mi.Ray3f(o, d, 0, path.wavelengths)
        si = path.hit.intersection().compute_surface_interaction(ray, mi.RayFlags.All)
        u = mi.Vector3f(tangents(si.p))
    return dr.detach(si), u


def sample_view(
    job: Job, table: EdgeTable, dist: EdgeDistribution, path: CameraPath, si, u, seed, samples: FilmSamples
) -> EdgeView | None:
    """One edge point per vertex; kept if the vertex sees it, scatters light from there, and they move apart."""
    rng = samples.sampler(seed, path.lane)
    row, t = sample_edge(dist, mi.Float64(rng.next_1d()))
    on = table.on(row, t, mi.Vector4f(si.p.x, si.p.y, si.p.z, 1))
    offset = mi.Vector3f(on.x - si.p)
    r = dr.norm(offset)
    ω = offset / r
    n_perp, across = on.across(ω)
    sight = Sight.of(on, row, t, ω, r, n_perp)
    with dr.resume_grad():
        v = mi.Vector3f(tangents(table.displacement(sight.at, ω)))
    n, _, silhouette = table.ask(row, lambda kind, own_row, own: kind.open_side(own_row, on.dx, ω, own))

    active = (across > 0) & (r > on.lead) & ((dr.dot(n_perp, v - u) != 0) | sources_move(job.facts))
    bsdf = si.bsdf()
    f = bsdf.eval(mi.BSDFContext(), si, si.to_local(ω), active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
    weight = path.β * f * across / (dr.square(r) * pmf(dist, row))
    active &= dr.any(weight != 0)
    # From the edge: where it rests on a surface, a ray to it would end beside it.
    back = mi.Ray3f(on.x - on.lead * ω, -ω, 0, path.wavelengths)
    back.maxt = (r - on.lead) * (1 - SHADOW_EPSILON)
    active &= ~job.scene.ray_test(back, active)
    passes = dr.select(silhouette, dr.select(dr.dot(n, n_perp) > 0, mi.UInt32(1), 0), 2)
    return compact(EdgeView(path.lane, sight, v, u, passes, weight, path.wavelengths), active)


def sources_move(facts: SceneFacts) -> bool:
    """Shadows move though neither edge nor receiver does."""
    return any(s.moves and s.is_emitter for s in facts.shapes)


def across(
    job: Job, table: EdgeTable, view: EdgeView, segments: int, seed, samples: FilmSamples
) -> tuple[mi.Spectrum, mi.UInt32]:
    """Both sides of every edge point, at most `segments` from x_k on: `(contribution, camera path)`, 2 lanes each."""
    index = dr.arange(mi.UInt32, 2 * dr.width(view.lane))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    x_k, n_perp = v.sight.viewer, v.sight.n_perp
    ray, pi, differs = look_beside(job.scene, table, v.sight, which, v.wavelengths)
    speed = dr.dot(n_perp, v.v - v.u)
    value = dr.zeros(mi.Spectrum, dr.width(index))
    if segments > 1:
        limits = replace(job.limits, max_depth=segments)
        rng = samples.sampler(seed, v.lane)
        L, _, _ = walk(job.scene, rng, ray, pi, limits, NoSink(), mi.Bool(False), differs)
        value += L * speed

    shines = differs & (which == v.passes)
    with dr.resume_grad():
        flags = mi.RayFlags.All | mi.RayFlags.FollowShape
        si = pi.compute_surface_interaction(ray, flags, shines)
        u_source = mi.Vector3f(tangents(si.p))
    si = dr.detach(si)
    ratio = dr.select(si.is_valid(), v.sight.r / dr.norm(si.p - x_k), 0)
    relative = dr.select(si.is_valid(), ratio * dr.dot(n_perp, u_source - v.u), 0)
    value += dr.select(shines, si.emitter(job.scene).eval(si, shines) * (speed - relative), 0)
    return v.weight * value * dr.select(which == 0, 1.0, -1.0), v.lane


def go_on(job: Job, path: CameraPath, si, u, k: int, seed, samples: FilmSamples) -> CameraPath | None:
    """To the next vertex, by BSDF sampling with roulette; paths that end are left out."""
    rng = samples.sampler(seed, path.lane)
    state = PathState(mi.UInt32(k - 1), path.β, path.η)
    onward = bounce(si, si.bsdf(), rng, state, job.limits, mi.BSDFContext(), mi.Bool(True))
    ray, alive = onward.ray(si), onward.alive
    β, η = onward.path.β, onward.path.η
    pi = job.scene.ray_intersect_preliminary(ray, coherent=False, active=alive)
    following = CameraPath(path.lane, Hit.of(ray, pi), u, dr.zeros(mi.Vector3f, dr.width(u)), β, η, path.wavelengths)
    return compact(following, alive & pi.is_valid())
