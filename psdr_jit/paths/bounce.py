"""The one step by which every path goes on: scattering, Russian roulette, next throughput.

    β_{k+1} = β_k · f cosθ / (pdf · survival)            survival = min(max(β_k f cosθ / pdf) η², 0.95) after `rr_depth`

Walks that record, that only look and that lead to the sensor differ in what they do at a vertex, never in this. Each
step draws its random numbers in the same order: one for the lobe, two for the direction, one for the roulette.
Radiance and importance (`ctx.mode`) go by the same step; where shading normals make a BSDF asymmetric, particles get
their correction here. Everything is detached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.records import Continuation
from ..scene.surfaces import Surfaces
from .critical_angle import CriticalAngle
from .edge_on import EdgeOn
from .light_technique import LightTechnique
from .scattering import Aim, Mixture, Scattering, accepted, mixture_pdf, sample_scattering

#: Largest probability with which the roulette lets a path live, as in Mitsuba's `path`.
MOST_SURVIVAL = 0.95


@dataclass(frozen=True)
class PathLimits:
    """Depths as in Mitsuba's `path`: `max_depth` counts segments, roulette starts at `rr_depth`."""

    max_depth: int
    rr_depth: int
    end_black: bool = True  # a throughput of 0 ends the path; not if its derivative is wanted
    uniform_share: float = 0.0  # of the directions, see `scattering`
    critical: CriticalAngle | None = None  # glass whose index is differentiated, see `critical_angle`
    refuses: bool = False  # some BSDF refuses directions it has sampled, and black paths go on: see `scattering`
    own_frames: bool = False  # some BSDF sees how its frame is turned about the normal: see `rays.interaction`
    surfaces: Surfaces | None = None  # that Mitsuba does not evaluate: see `surface_at`
    light: LightTechnique | None = None  # light subpaths find paths as well: weights leave them their share
    aim: Aim | None = None  # where the next direction is worth taking
    aligned: bool = False  # numbers of mirrors and glass are their own: see `walk`
    edge_on: EdgeOn | None = None  # walks begin beside an edge, which may be the outline of one of these

    @property
    def mixture(self) -> Mixture:
        """How directions are sampled."""
        return Mixture(self.uniform_share, self.critical, self.aim)

    def looking_within(self, within: mi.Bool | None) -> PathLimits:
        """Limits of walks from beside edges that are, where `within`, steps inside of a surface; None: nowhere."""
        if within is None or self.edge_on is None:
            return self
        return replace(self, edge_on=replace(self.edge_on, within=within))

    def beyond(self, k: mi.UInt32) -> PathLimits:
        """Limits of paths that have `k` segments behind them already, lane by lane."""
        return replace(self, max_depth=mi.UInt32(self.max_depth) - k)


@dataclass
class PathState:
    """What a path carries to its next vertex. A PyTree: part of a loop's state."""

    k: mi.UInt32  # number of that vertex
    β: mi.Spectrum  # throughput up to it
    η: mi.Float  # accumulated refractive index: the roulette must not see the radiance compression at refraction

    @staticmethod
    def start(k: int = 0) -> PathState:
        return PathState(mi.UInt32(k), mi.Spectrum(1), mi.Float(1))


@dataclass
class Bounce:
    """How a path goes on from a vertex."""

    scattering: Scattering
    survival: mi.Float  # probability that the roulette lets it live
    alive: mi.Bool  # the direction has a density, and the path survives
    path: PathState  # as it arrives at the next vertex

    def ray(self, si: mi.SurfaceInteraction3f) -> mi.Ray3f:
        """The ray to the next vertex."""
        return si.spawn_ray(si.to_world(self.scattering.wo))

    def likelihood(self) -> Continuation:
        """What a record keeps of it."""
        s = self.scattering
        return Continuation(dr.select(self.alive, s.pdf, 0), self.survival, self.alive & s.delta)


def bounce(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, sampler, path: PathState, limits: PathLimits, ctx, active: mi.Bool
) -> Bounce:
    """Go on from `si` in the transport mode of `ctx`."""
    u_lobe, u = sampler.next_1d(), sampler.next_2d()
    s = sample_scattering(ctx, si, bsdf, u_lobe, u, limits.mixture, limits.refuses, active)
    if ctx.mode == mi.TransportMode.Importance:
        onward = si.to_world(s.wo)
        weight = s.weight * particle_correction(si, onward)
        if limits.own_frames:  # a frame that `si` does not know bends the cosine
            f = particle_eval(si, bsdf, onward, active & ~s.delta & (s.pdf > 0))
            weight = dr.select(s.delta, weight, f * dr.select(s.pdf > 0, dr.rcp(s.pdf), 0))
        s.weight = weight
    return _after_roulette(s, sampler, path, limits, active)


def evaluate_and_bounce(
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    wo: mi.Vector3f,
    sampler,
    path: PathState,
    limits: PathLimits,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float, Bounce]:
    """`bounce` of radiance, and the BSDF in a given local direction `wo`: `(f cosθ, pdf, Bounce)`."""
    ctx, mixture = mi.BSDFContext(), limits.mixture
    if not mixture.plain:
        f, pdf = bsdf.eval_pdf(ctx, si, wo, active)
        return f, mixture_pdf(si, bsdf, wo, pdf, mixture), bounce(si, bsdf, sampler, path, limits, ctx, active)
    u_lobe, u = sampler.next_1d(), sampler.next_2d()
    f, pdf, bs, weight = bsdf.eval_pdf_sample(ctx, si, wo, u_lobe, u, active)  # in one virtual call
    s = accepted(ctx, si, bsdf, bs, weight, limits.refuses, active)
    return f, pdf, _after_roulette(s, sampler, path, limits, active)


def _after_roulette(s: Scattering, sampler, path: PathState, limits: PathLimits, active: mi.Bool) -> Bounce:
    """Russian roulette by Mitsuba's criterion."""
    β, η = path.β * s.weight, path.η * s.η
    β_max = dr.max(β)
    survival = dr.select(path.k + 1 >= limits.rr_depth, dr.minimum(β_max * dr.square(η), MOST_SURVIVAL), 1)
    if not limits.end_black:  # what is black has a derivative all the same
        survival = dr.select(β_max == 0, MOST_SURVIVAL, survival)
    survives = sampler.next_1d() < survival
    if limits.end_black:
        survives &= β_max != 0
    following = PathState(path.k + 1, β * dr.select(survives, dr.rcp(survival), 0), η)
    return Bounce(s, survival, active & survives & (s.pdf > 0), following)


def particle_eval(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, onward: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """f cosθ of particles that leave in the direction `onward`, world space: what light from there to here meets.

    It is `path`'s own BSDF, with both directions exchanged: a bump map bends the frame in which the cosine of the
    *light* is taken, of which `si` knows nothing.
    """
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = si.to_local(onward)
    f = bsdf.eval(mi.BSDFContext(), seen, si.wi, active)
    arriving = dr.dot(si.n, si.to_world(si.wi))
    return f * dr.select(arriving != 0, dr.abs(dr.dot(si.n, onward) / arriving), 0)


def particle_correction(si: mi.SurfaceInteraction3f, onward: mi.Vector3f) -> mi.Float:
    """Shading normals make a BSDF asymmetric: factor for particles [Veach 1997, Eq. 5.19], as in `ptracer`.

    `onward`: direction in which the particle leaves, world space.
    """
    out = si.to_local(onward)
    shading = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, onward)
    geometric = mi.Frame3f.cos_theta(out) * dr.dot(si.n, si.to_world(si.wi))
    return dr.select(geometric != 0, dr.abs(shading / geometric), 0)
