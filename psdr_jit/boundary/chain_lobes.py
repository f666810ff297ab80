"""How the chains of a line leave their vertices: by the reflected lobe, the one that leads through, or a smooth one.

Which one is a matter of random numbers and of shares that the line keeps (`chain_fixed`), wherever on a surface the
vertex is. The shares follow the guides, so that few chains go where little light comes from, but for a defensive rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..paths.bounce import particle_eval
from ..paths.delta_step import FIRST_LOBE, LAST_LOBE
from .chain_fixed import EVEN, Direction

#: Least share of the chains that are reflected, and that are let through, where a surface does both.
LOBE_SHARE = 0.1

#: Share of the chains that go on by a smooth lobe where a surface has both kinds.
SMOOTH_SHARE = 0.5


@dataclass
class Leaving:
    """How a chain goes on."""

    ray: mi.Ray3f
    factor: mi.Spectrum  # value of the lobe over the probability of its choice
    alive: mi.Bool
    by_delta: mi.Bool


def has_delta(bsdf: mi.BSDFPtr) -> mi.Bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)


def smooth_choice(bsdf: mi.BSDFPtr, k: mi.UInt32, u: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Is vertex `k` left by a smooth lobe, and with which probability was that chosen? The first one never is."""
    flags = bsdf.flags()
    smooth, delta = mi.has_flag(flags, mi.BSDFFlags.Smooth) & (k > 0), has_delta(bsdf)
    chosen = smooth & (~delta | (u < SMOOTH_SHARE))
    share = dr.select(chosen, mi.Float(SMOOTH_SHARE), 1 - SMOOTH_SHARE)
    return chosen, dr.select(smooth & delta, share, 1)


def leave(
    si: mi.SurfaceInteraction3f, k: mi.UInt32, u: mi.Point2f, fixed: Direction, active: mi.Bool, ctx: mi.BSDFContext
) -> Leaving:
    """Go on from vertex `k`: in the `fixed` direction, or by a delta lobe; `u` chooses. `ctx` tells what is carried."""
    bsdf = si.bsdf()
    smooth, share = smooth_choice(bsdf, k, u.x)
    smooth &= active
    onward = _delta_leave(si, ctx, (u.y, fixed.reflected), active & ~smooth)
    if ctx.mode == mi.TransportMode.Importance:
        f = particle_eval(si, bsdf, fixed.ω, smooth)
    else:
        f = bsdf.eval(ctx, si, si.to_local(fixed.ω), smooth)
    ray = dr.select(smooth, si.spawn_ray(fixed.ω), onward.ray)
    factor = dr.select(smooth, f * dr.select(fixed.pdf > 0, dr.rcp(fixed.pdf), 0), onward.factor) / share
    return Leaving(ray, factor, (smooth & dr.any(factor != 0)) | onward.alive, onward.alive)


def _delta_kinds(bsdf: mi.BSDFPtr) -> tuple[mi.Bool, mi.Bool]:
    """`(does it reflect, does it let through)` by a delta lobe."""
    flags = bsdf.flags()
    passes = mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) | mi.has_flag(flags, mi.BSDFFlags.Null)
    return mi.has_flag(flags, mi.BSDFFlags.DeltaReflection), passes


def _delta_leave(si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext, choice: tuple, active: mi.Bool) -> Leaving:
    """By the reflected lobe or the one that leads through; `choice`: (random number, share of the reflected one)."""
    u, share = choice
    reflects, passes = _delta_kinds(si.bsdf())
    through = passes & (~reflects | (u >= share))
    probability = dr.select(reflects & passes, dr.select(through, 1 - share, share), 1)
    value, bs = _lobe(si, ctx, through, active & (reflects | passes))
    alive = dr.any(value != 0)
    return Leaving(si.spawn_ray(si.to_world(bs.wo)), dr.select(alive, value / probability, 0), alive, alive)


def _lobe(si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext, through: mi.Bool, active: mi.Bool):
    """`(value, sample)` of the delta lobe that leads through the surface, or of the other one; 0 if it has none."""
    bsdf, number = si.bsdf(), dr.select(through, mi.Float(LAST_LOBE), FIRST_LOBE)
    bs, weight = bsdf.sample(ctx, si, number, mi.Point2f(0.5), active)
    crosses = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) < 0
    there = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (bs.pdf > 0) & (crosses == through)
    null = there & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    value = dr.select(null, bsdf.eval_null_transmission(si, null), weight * bs.pdf)
    return dr.select(there, value, 0), bs


def reflected_share(of: tuple, active: tuple) -> mi.Float:
    """Share of the chains that are reflected: as the guides' vertices `of` do, on average, but for a defensive rest."""
    total, count, ctx = mi.Float(0), mi.Float(0), mi.BSDFContext()
    for si, alive in zip(of, active, strict=True):
        reflects, passes = _delta_kinds(si.bsdf())
        both = alive & reflects & passes
        r, t = (dr.mean(mi.unpolarized_spectrum(_lobe(si, ctx, mi.Bool(p), both)[0])) for p in (False, True))
        known = both & (r + t > 0)
        total += dr.select(known, r / (r + t), 0)
        count += dr.select(known, mi.Float(1), 0)
    return dr.select(count > 0, LOBE_SHARE + (1 - 2 * LOBE_SHARE) * total / count, EVEN)
