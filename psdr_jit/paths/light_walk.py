"""Light subpaths, one connection of each to the sensor: paths that are found from the light and read from the sensor.

A subpath y_0, y_1, … goes on by BSDF sampling of importance. Every vertex y_s, s ≥ 2, is connected to the sensor, which
makes a path x_k = y_{s+1−k}. What that is worth is not the particle's own weight but the integrand of the camera's
path, so that both estimate one integral whatever a BSDF does with its two sides: with F_k the BSDF times cosine *as
read from the sensor*, and the densities of `light_technique.py`,

    W = w_L · (L_e/E) Π_{k=2..s} F_k c_k^-/(p̃_k c_k^+) · F_1 c_1^-/(c_1^+ J)                    [per pixel area]

is splatted where the sensor sees x_1, and the image is its mean over the subpaths. Where shading normals differ from
geometric ones, the cosines are Veach's correction for particles. The inverse of p_L/p_B runs along,

    U = (1/E) Π_{k=2..s} p_k c_k^-/(p̃_k c_k^+) · (n_E/n_L) p_1 c_1^-/(c_1^+ J),        w_L = 1/(1 + U²)

with √(p_s² + p_em²) for p_s, so that both other techniques are in it.

At a delta lobe, F_k is its value, p_k and p̃_k are probabilities, and étendue puts (η_k^+/η_k^-)² in place of the
cosines. What a delta light sends through such a lobe first of all has w_L = 1: nothing else finds it (`alone`).

One connection of each subpath is kept, with a probability proportional to what it brings, and stands for all (weighted
reservoir sampling; in expectation nothing changes). So a subpath costs one record, however long. Detached throughout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.sensor_frame import View, look_at
from .bounce import PathLimits, PathState, bounce
from .delta_step import delta_step
from .light_source import LightStart
from .light_technique import SHORTEST, LightTechnique, average, cosine_ratio, focuses, seen_aslant
from .light_vertices import LightVertices
from .rays import interaction
from .scattering import Mixture, Scattering, delta_probability, mixture_pdf
from .sensor_connection import on_film, seen_by_sensor

#: Share of what is black in the probability of being kept, where the derivative of what is black is wanted.
BLACK_SHARE = 0.05


@dataclass
class LightPath:
    """The connection that was kept. Detached, one entry per lane; a PyTree."""

    value: mi.Spectrum  # to be splatted, over the number of subpaths; 0: none
    scale: mi.Float  # the same without L_e and the F_k
    count: mi.UInt32  # its surface vertices, 0: none
    alone: mi.Bool  # of a class that no camera path finds
    p: mi.Point2f  # film position [px]
    film: mi.Point2f  # the same in [0, 1]² of the crop window
    aperture: mi.Point2f
    total: mi.Float  # of the probabilities of all connections so far, not normalised
    own: mi.Float  # the one of this

    @staticmethod
    def none() -> LightPath:
        zero = mi.Float(0)
        point = mi.Point2f(0)
        return LightPath(mi.Spectrum(0), zero, mi.UInt32(0), mi.Bool(False), point, point, mi.Point2f(0.5), zero, zero)

    def offered(self, other: LightPath, u: mi.Float) -> LightPath:
        """This or `other`, which has an `own` only."""
        total = self.total + other.own
        kept = dr.select((other.own > 0) & (u * total < other.own), other, self)
        kept.total = total
        return kept

    def standing_for_all(self) -> LightPath:
        """Scaled to what all connections bring in expectation."""
        up = dr.select(self.own > 0, self.total / self.own, 0)
        return replace(self, value=self.value * up, scale=self.scale * up)


@dataclass
class _Carried:
    """What a light subpath carries to its next vertex. A PyTree."""

    β: mi.Spectrum  # L_e/E Π F_k c_k^-/(p̃_k c_k^+), over the roulette's survival probabilities
    scale: mi.Float  # the same without L_e and the F_k
    U: mi.Float  # see the module
    likely: mi.Float  # as β, with the densities p_k for F_k: not 0 where the path is black
    alone: mi.Bool  # see `LightPath`

    @staticmethod
    def of(value: mi.Spectrum, E: mi.Float) -> _Carried:
        inverse = dr.select(E > 0, dr.rcp(E), 0)
        β = value * inverse
        return _Carried(β, inverse, mi.Float(inverse), average(β), mi.Bool(False))


@dataclass
class _Turn:
    """A vertex of a light subpath with a direction towards the sensor, read from there."""

    F: mi.Spectrum  # BSDF times cosine
    p: mi.Float  # density with which a camera path goes on to the light's side
    step: mi.Float  # c^-/c^+

    @staticmethod
    def towards(wo: mi.Vector3f, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, mixture: Mixture, active) -> _Turn:
        """`wo`: local. `mixture`: of the camera's paths."""
        turned = mi.SurfaceInteraction3f(si)
        turned.wi = mi.Vector3f(wo)
        F, p = bsdf.eval_pdf(mi.BSDFContext(), turned, si.wi, active)
        return _Turn(F, mixture_pdf(turned, bsdf, si.wi, p, mixture), cosine_ratio(si, wo))

    @staticmethod
    def by_delta(wo: mi.Vector3f, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, mixture: Mixture, active) -> _Turn:
        """The same at a delta lobe: its value, its probability, and what étendue makes of the step."""
        turned = mi.SurfaceInteraction3f(si)
        turned.wi = mi.Vector3f(wo)
        lobe = delta_step(mi.BSDFContext(), turned, bsdf, si.to_world(si.wi), active)
        return _Turn(lobe.value, delta_probability(bsdf, lobe.probability, mixture), dr.square(lobe.η))


def _first_segment(
    scene: mi.Scene, technique: LightTechnique, start: LightStart, pi, limits: PathLimits
) -> tuple[_Carried, mi.Float]:
    """What arrives at y_1, and the density p_em with which an emitter sample there finds y_0."""
    si = interaction(pi, start.ray, limits)
    emitter = dr.reinterpret_array(mi.EmitterPtr, start.emitter)
    valid = pi.is_valid()
    E = technique.sources.segment_density(start.emitter, start.y, start.n, start.ray.d, si.p, valid)
    of_delta, irradiance = emitter.sample_direction(si, mi.Point2f(0.5), valid & start.delta)
    value = dr.select(start.delta, irradiance, start.radiance)

    ds = mi.DirectionSample3f(of_delta)
    ds.p, ds.n, ds.emitter = start.y, start.n, emitter
    ds.dist = dr.norm(start.y - si.p)
    ds.d = -start.ray.d
    pdf = scene.pdf_emitter_direction(si, ds, valid & ~start.delta)
    pdf = dr.select(start.delta, dr.gather(mi.Float, technique.sources.choice, start.emitter, valid), pdf)
    return _Carried.of(dr.select(valid & si.is_valid(), value, 0), E), pdf


def _connected(
    technique: LightTechnique, u: mi.Point2f, si, s: mi.UInt32, carried: _Carried, limits: PathLimits, active: mi.Bool
) -> tuple[LightPath, View]:
    """The path that connects `si`, the surface vertex number `s` from 1, to the sensor, before occlusion."""
    aperture = u if technique.frame.kind == "thinlens" else mi.Point2f(0.5)
    view = look_at(technique.frame, si.p, aperture)
    bsdf = si.bsdf()
    margin = dr.select(carried.alone, technique.margin, 0)
    seen = active & on_film(technique.frame, view, margin) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    seen &= carried.alone | ~seen_aslant(si, view.ω)
    turn = _Turn.towards(si.to_local(-view.ω), si, bsdf, limits.mixture, seen)
    end = turn.step / view.J_px
    U = carried.U * turn.p * end / technique.ratio
    w = mi.Float(1) if technique.exclusive else dr.rcp(1 + dr.square(U))
    value = carried.β * turn.F * (end * w)
    own = average(value)
    if not limits.end_black:
        own += BLACK_SHARE * carried.likely * turn.p * end * w
    own = dr.select(seen & dr.isfinite(own), own, 0)
    zero = mi.Float(0)
    return LightPath(value, carried.scale * end * w, s, carried.alone, view.p, view.film, aperture, zero, own), view


@dataclass
class Onset:
    """Where a light subpath is taken up: the segment in hand, what it carries, and what lies behind it. A PyTree."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f  # what it meets
    carried: _Carried
    path: PathState
    delta: mi.Bool  # the light is a delta light
    pdf_em: mi.Float  # density of an emitter sample at the first vertex


def trace_light(
    scene: mi.Scene,
    sampler,
    start: LightStart,
    limits: PathLimits,
    hide_emitters: bool,
    vertices: LightVertices | None = None,
) -> LightPath:
    """Trace light subpaths; returns the connection that each keeps, and fills `vertices` if given. Detached.

    `limits`: of the camera's paths, with their `light`.
    """
    ray = mi.Ray3f(start.ray)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=True)
    carried, pdf_em = _first_segment(scene, limits.light, start, pi, limits)
    onset = Onset(ray, pi, carried, PathState.start(), start.delta, pdf_em)
    return _follow(scene, sampler, onset, limits, (hide_emitters, False), vertices)


def take_up(
    scene: mi.Scene,
    sampler,
    hit: Hit,
    β: mi.Spectrum,
    k: mi.UInt32,
    wavelengths,
    limits: PathLimits,
    hide_emitters: bool,
) -> LightPath:
    """Go on along the segments `hit`, number `k` of paths from points of light, which carry `β`. Detached.

    None but paths count that nothing else finds (`LightPath.alone`): behind the first segment they must be such.
    """
    ray = mi.Ray3f(hit.o, hit.d, 0, wavelengths)
    pi = hit.intersection()
    carried = _Carried.of(dr.select(pi.is_valid(), β, 0), mi.Float(1))
    carried.alone, carried.U = k > 0, mi.Float(0)
    onset = Onset(ray, pi, carried, PathState(mi.UInt32(k), mi.Spectrum(1), mi.Float(1)), mi.Bool(True), mi.Float(0))
    return _follow(scene, sampler, onset, limits, (hide_emitters, True), None)


@dr.syntax
def _follow(
    scene: mi.Scene, sampler, onset: Onset, limits: PathLimits, only: tuple[bool, bool], vertices: LightVertices | None
) -> LightPath:
    """`only`: (hidden emitters are transparent, none but paths that are `alone` count)."""
    technique, (hide_emitters, only_alone) = limits.light, only
    own = replace(limits, uniform_share=0.0, critical=technique.critical, light=None)
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    ray, pi, carried, path = onset.ray, onset.pi, onset.carried, onset.path
    delta_light, pdf_em = onset.delta, onset.pdf_em
    kept = LightPath.none()
    active = pi.is_valid() & (carried.scale > 0)
    while dr.hint(active, label="psdr.light_walk", exclude=[technique, limits, own, only_alone]):
        si = interaction(pi, ray, limits)
        bsdf = si.bsdf()
        first = path.k == 0
        s = path.k + 1
        ends = active & (s >= SHORTEST) & (carried.alone | ~mi.Bool(only_alone))
        found, view = _connected(technique, sampler.next_2d(), si, s, carried, limits, ends)
        found.own = dr.select(seen_by_sensor(scene, si, view, hide_emitters, found.own > 0), found.own, 0)
        kept = kept.offered(found, sampler.next_1d())

        onward = bounce(si, bsdf, sampler, path, own, ctx, active & (~first | _begins(bsdf, delta_light)))
        delta = onward.scattering.delta
        if vertices is not None:
            vertices.write(path.k, si, pi, delta, active)
        alive = onward.alive & (s < technique.longest) & (~first | delta | focuses(bsdf))
        turn = _turn(technique, onward.scattering, si, bsdf, limits, alive)
        step = turn.step / onward.scattering.pdf
        p = dr.select(first, _root(delta_light, turn.p, dr.select(delta, 0, pdf_em)), turn.p)
        carried = dr.select(
            alive,
            _Carried(
                carried.β * turn.F * (step / onward.survival),
                carried.scale * step / onward.survival,
                carried.U * p * step,
                carried.likely * turn.p * step / onward.survival,
                carried.alone | (first & delta_light & delta),
            ),
            carried,
        )
        path = onward.path
        ray = onward.ray(si)
        active = alive & dr.isfinite(carried.U)
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
    return kept.standing_for_all()


def _begins(bsdf: mi.BSDFPtr, delta_light: mi.Bool) -> mi.Bool:
    """Does light go on from its first surface? That of points from all that mirror, plastic as well."""
    flags = bsdf.flags()
    mirrors = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) | mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
    return focuses(bsdf) | (delta_light & mirrors)


def _turn(technique: LightTechnique, s: Scattering, si, bsdf: mi.BSDFPtr, limits: PathLimits, active) -> _Turn:
    """The vertex `si`, left by `s`, as read from the sensor."""
    smooth = _Turn.towards(s.wo, si, bsdf, limits.mixture, active & ~s.delta)
    if not technique.delta_lobes:
        return smooth
    return dr.select(s.delta, _Turn.by_delta(s.wo, si, bsdf, limits.mixture, active & s.delta), smooth)


def _root(delta_light: mi.Bool, p: mi.Float, pdf_em: mi.Float) -> mi.Float:
    """√(p_B² + p_N²) at x_s: a delta light is not met by scattering."""
    return dr.sqrt(dr.select(delta_light, 0, dr.square(p)) + dr.square(pdf_em))
