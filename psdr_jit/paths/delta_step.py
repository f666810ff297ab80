"""What a path does at a delta lobe, as a function of the attached surface: mirrors, smooth glass, windows and masks.

At a smooth vertex a direction is drawn and then stays what it is. At a delta lobe it follows from the arrival and from
the normal: with n the shading normal and ω the direction of travel, away from the sensor,

    reflection   ω' = ω − 2 n (n·ω)
    refraction   ω' = ρ ω + (ρ c − c_t) n,      ρ = η_i/η_t, c = −n·ω, c_t² = 1 − ρ² (1 − c²)
    null         ω' = ω

Mitsuba's own `bsdf.sample` is asked for it with an attached surface, so that each plugin brings its lobes, its Fresnel
term and its tints. A lobe is not chosen anew: all plugins take the reflected lobe (of a mask: what it masks) for the
lowest random numbers and the other one for the highest.

What a lobe is worth is weight × probability, both attached, since some plugins attach the one and some the other; of a
null lobe it is `eval_null_transmission` [Mitsuba 3.9.1, `src/bsdfs`].
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Random numbers for which plugins take the first of their lobes, and the last.
FIRST_LOBE, LAST_LOBE = 0.0, 1 - 2**-24


@dataclass
class DeltaStep:
    """How a path leaves a delta lobe. Attached to the surface and to the ray that meets it."""

    d: mi.Vector3f  # unit, world space
    value: mi.Spectrum  # of the lobe: what its weight is worth times the probability of choosing it
    η: mi.Float  # relative refractive index along the direction
    probability: mi.Float  # with which the BSDF chooses the lobe


def delta_step(
    ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, onward: mi.Vector3f, active: mi.Bool
) -> DeltaStep:
    """Leave `si` by the delta lobe that leads in the direction `onward` (detached, world space).

    Reflected and transmitted lobes lead to different sides, so the direction tells which one it is.
    """
    wi, wo = dr.detach(si.wi), dr.detach(si.to_local(onward))
    through = mi.Frame3f.cos_theta(wi) * mi.Frame3f.cos_theta(wo) < 0
    bs, weight = bsdf.sample(ctx, si, dr.select(through, LAST_LOBE, FIRST_LOBE), mi.Point2f(0.5), active)
    null = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    value = dr.select(null, bsdf.eval_null_transmission(si, null), weight * bs.pdf)
    return DeltaStep(dr.replace_grad(onward, si.to_world(bs.wo)), value, bs.eta, dr.detach(bs.pdf))
