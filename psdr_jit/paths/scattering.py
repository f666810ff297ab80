"""How a path goes on at a surface: BSDF sampling, with a share of even choices where derivatives need it.

A derivative divides by cosines that the value does not have: a surface that turns changes cosθ itself, and a vertex
slides by 1/cosθ. Under a density that vanishes with cosθ, as that of a diffuse BSDF does, the variance of
such a weight is infinite. A defensive mixture bounds it [Veach 1997, §9.2.4; Hesterberg 1995]. So does a share of
directions close to total reflection, where an index of refraction is differentiated (`critical_angle.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from .critical_angle import CriticalAngle
from .delta_step import FIRST_LOBE, LAST_LOBE

#: Share of uniform directions where derivatives are estimated along a path.
UNIFORM_SHARE = 0.25

#: Share of directions that are aimed, where there is an aim.
AIMED_SHARE = 0.5


class Directions(Protocol):
    """A distribution of directions in world space."""

    @property
    def total(self) -> mi.Float:
        """0 where there is none."""

    def sample(self, u: mi.Point2f) -> mi.Vector3f: ...

    def pdf(self, d: mi.Vector3f) -> mi.Float: ...


@dataclass(frozen=True)
class Aim:
    """Directions that are worth taking from a vertex. Host object."""

    directions: Directions
    wanted: mi.Bool  # lanes that take a share of them

    def share(self, bsdf: mi.BSDFPtr) -> mi.Float:
        return _share(bsdf, dr.select(self.wanted & (self.directions.total > 0), AIMED_SHARE, mi.Float(0)))


@dataclass(frozen=True)
class Mixture:
    """What is mixed with the sampling of BSDFs. Host object."""

    uniform: float = 0.0  # share of uniform directions
    critical: CriticalAngle | None = None  # brings its own share of the others
    aim: Aim | None = None  # the same, before both

    @property
    def plain(self) -> bool:
        """Nothing is."""
        return self.uniform == 0 and self.critical is None and self.aim is None


#: Sampling as the BSDF has it.
PLAIN = Mixture()


@dataclass
class Scattering:
    """A sampled direction. Detached, one entry per lane."""

    wo: mi.Vector3f  # unit, local frame
    pdf: mi.Float  # per solid angle; of a delta lobe, its probability
    weight: mi.Spectrum  # f cosθ / pdf
    η: mi.Float  # relative refractive index along the direction
    delta: mi.Bool


def mixture_pdf(si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, pdf_bsdf: mi.Float, mixture: Mixture) -> mi.Float:
    """Density of `sample_scattering` in direction `wo` (local) where the BSDF alone has `pdf_bsdf`."""
    if mixture.plain:
        return pdf_bsdf
    if mixture.critical is not None:
        near = mixture.critical.share(bsdf, si.wi)
        pdf_bsdf = (1 - near) * pdf_bsdf + near * mixture.critical.pdf(bsdf, si.wi, wo)
    through = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
    same_side = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) > 0
    uniform = dr.select(through, dr.inv_four_pi, dr.select(same_side, dr.inv_two_pi, 0))
    share = _share(bsdf, mixture.uniform)
    pdf = share * uniform + (1 - share) * pdf_bsdf
    if mixture.aim is not None:
        aimed = mixture.aim.share(bsdf)
        pdf = aimed * mixture.aim.directions.pdf(si.to_world(wo)) + (1 - aimed) * pdf
    return pdf


def reverse_pdf(ctx, si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, mixture: Mixture, active: mi.Bool) -> mi.Float:
    """Density of the same turn taken the other way: arriving from `wo` (local), `sample_scattering` goes to `si.wi`.

    Per solid angle at the vertex, in the transport mode opposite to that of `ctx`; delta lobes have none: 0.
    """
    radiance, importance = mi.TransportMode.Radiance, mi.TransportMode.Importance
    opposite = mi.BSDFContext(radiance if ctx.mode == importance else importance)
    turned = mi.SurfaceInteraction3f(si)
    turned.wi = mi.Vector3f(wo)
    return mixture_pdf(turned, bsdf, si.wi, bsdf.pdf(opposite, turned, si.wi, active), mixture)


def _share(bsdf: mi.BSDFPtr, share: float | mi.Float) -> mi.Float:
    """Delta lobes keep pure BSDF sampling: their probability is not a density."""
    return dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta), 0, share)


def _two_delta_lobes(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Does it reflect and let through, perfectly specularly?

    One of the lobes ends where the surface is seen edge-on or reflects totally. Its value T goes to 0 there as √x does
    with the distance x from that place, and its derivative as 1/√x: chosen with probability T, it would be Ṫ²/T.
    """
    flags = bsdf.flags()
    through = mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) | mi.has_flag(flags, mi.BSDFFlags.Null)
    return mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) & through


def delta_probability(bsdf: mi.BSDFPtr, alone: mi.Float, mixture: Mixture) -> mi.Float:
    """Probability with which `sample_scattering` takes a delta lobe that the BSDF `alone` takes with that one.

    Where one of two lobes is not there, such as in total reflection, every choice leads to the other one.
    """
    share = mixture.uniform
    return dr.select(_two_delta_lobes(bsdf) & (alone < 1), share / 2 + (1 - share) * alone, alone)


def _refused(weight: mi.Spectrum, f: mi.Spectrum) -> mi.Bool:
    """Samples that a BSDF sent back with weight 0 though it is not 0 there.

    A rough dielectric whose reflected direction ends on the wrong side does so, with the density of a sample that did
    not happen; `f` and `pdf` at that direction are those of its other lobe.
    """
    return (dr.max(weight) == 0) & (dr.max(f) != 0)


def accepted(ctx, si, bsdf: mi.BSDFPtr, bs, weight: mi.Spectrum, refuses: bool, active: mi.Bool) -> Scattering:
    """The outcome of `bsdf.sample`. `refuses`: density 0 for `_refused` directions, where paths go on at weight 0."""
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    pdf = mi.Float(bs.pdf)
    if refuses:
        pdf = dr.select(~delta & _refused(weight, bsdf.eval(ctx, si, bs.wo, active & ~delta)), 0, pdf)
    return Scattering(bs.wo, pdf, weight, bs.eta, delta)


def sample_scattering(
    ctx, si, bsdf: mi.BSDFPtr, u_lobe: mi.Float, u: mi.Point2f, mixture: Mixture, refuses: bool, active: mi.Bool
) -> Scattering:
    """Direction in which a path goes on: by one of the densities of `mixture`, else sampled from the BSDF.

    Of two delta lobes, each is chosen with half of the probability of a uniform direction, else as the BSDF does.
    """
    if mixture.plain:
        bs, weight = bsdf.sample(ctx, si, u_lobe, u, active)
        return accepted(ctx, si, bsdf, bs, weight, refuses, active)
    share = mixture.uniform
    aimed = mi.Bool(False)
    if mixture.aim is not None:
        of_aim = mixture.aim.share(bsdf)
        aimed = u_lobe < of_aim
        u_lobe = dr.select(aimed, u_lobe / of_aim, (u_lobe - of_aim) / (1 - of_aim))
    q = _share(bsdf, share)
    uniform = ~aimed & (u_lobe < q)
    two_lobes = _two_delta_lobes(bsdf)
    evenly = two_lobes & (u_lobe < share)
    skipped = dr.select(two_lobes, share, q)
    u_lobe = dr.select(u_lobe < skipped, u_lobe / skipped, (u_lobe - skipped) / (1 - skipped))
    critical = mi.Bool(False)
    if mixture.critical is not None:
        near = mixture.critical.share(bsdf, si.wi)
        critical = ~aimed & ~uniform & (u_lobe < near)
        u_lobe = dr.select(uniform, u_lobe, (u_lobe - near) / (1 - near))
    u_lobe = dr.select(evenly, dr.select(u_lobe < 0.5, FIRST_LOBE, LAST_LOBE), u_lobe)
    bs, weight = bsdf.sample(ctx, si, u_lobe, u, active & ~aimed & ~uniform & ~critical)
    delta = ~aimed & ~uniform & ~critical & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)

    hemisphere = mi.warp.square_to_uniform_hemisphere(u)
    through = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
    below = dr.select(through, u_lobe < 0.5, mi.Frame3f.cos_theta(si.wi) < 0)
    hemisphere.z = dr.select(below, -hemisphere.z, hemisphere.z)
    wo = dr.select(uniform, hemisphere, bs.wo)
    if mixture.critical is not None:
        wo = dr.select(critical, mixture.critical.sample(bsdf, si.wi, u), wo)
    if mixture.aim is not None:
        wo = dr.select(aimed, si.to_local(mixture.aim.directions.sample(u)), wo)

    f, pdf_bsdf = bsdf.eval_pdf(ctx, si, wo, active & ~delta)
    pdf = mixture_pdf(si, bsdf, wo, pdf_bsdf, mixture)
    reflected = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) > 0
    found = aimed | uniform | (critical & reflected) | (~critical & (bs.pdf > 0) & ~_refused(weight, f))
    found &= pdf > 0
    if mixture.critical is not None:
        found &= ~mixture.critical.blurred(bsdf, si.wi, wo)
    chosen = delta_probability(bsdf, bs.pdf, mixture)
    of_delta = dr.select(chosen > 0, weight * (bs.pdf / chosen), 0)
    weight = dr.select(delta, of_delta, dr.select(found, f / pdf, 0))
    η = dr.select(aimed | uniform | critical, 1, bs.eta)  # of uniform directions unknown; it only steers the roulette
    pdf = dr.select(delta, chosen, dr.select(found, pdf, 0))
    return Scattering(wo, pdf, weight, η, delta)
