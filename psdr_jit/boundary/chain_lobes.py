"""How the chains of a line leave their vertices: by the reflected lobe, the one that leads through, or a smooth one.

Of two delta lobes each is chosen as often as the BSDF would where the vertex is, but for a defensive rest. The choice
may then change along the line, its random number being the same; that is no step of what is seen: with probability p(x)
of a lobe at the place x, a crossing there brings 1/p(x) of what it does by that lobe, and is met with probability p(x).
The search finds such places as it does crossings (`chain_search`), and leaves them.

One number chooses at vertex after vertex: what it is within the interval of the lobe that it chose is uniform again
(`LobeNumber`). So a chain of lobes with probability P has one interval of length P, of which well spread numbers meet
the right share; by numbers of their own, of 8 lines across a ball of glass 7 ± 1 would pass straight through.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..paths.bounce import particle_eval
from ..paths.delta_step import FIRST_LOBE, LAST_LOBE
from .chain_fixed import Direction

#: Least probability of either of two delta lobes. Where lamps are mirrored in glass more would be better (.1: a sixth
#: less noise), where pictures are seen through it less (.1: half as much noise again, and more).
LEAST_LOBE = 0.04

#: Length of the interval within which a lobe number is drawn anew: its last digits are spent.
SPENT = 2.0**-6

ALMOST_ONE = 1 - 2.0**-24  # rounding must not lead out of [0, 1)

#: Share of the chains that go on by a smooth lobe where a surface has both kinds.
SMOOTH_SHARE = 0.5


@dataclass
class LobeNumber:
    """What is left of a random number that chose lobes, and the length of the interval that it was in."""

    u: mi.Float
    length: mi.Float

    @staticmethod
    def begin(u: mi.Float) -> LobeNumber:
        return LobeNumber(mi.Float(u), mi.Float(1))

    def or_fresh(self, u: mi.Float) -> LobeNumber:
        """This, or another one where it is spent."""
        return dr.select(self.length < SPENT, LobeNumber(u, mi.Float(1)), self)

    def behind(self, onward: Leaving, active: mi.Bool) -> LobeNumber:
        """What is left once it chose `onward`."""
        left = LobeNumber(onward.rest, self.length * onward.probability)
        return dr.select(active & onward.by_delta, left, self)


@dataclass
class Leaving:
    """How a chain goes on."""

    ray: mi.Ray3f
    factor: mi.Spectrum  # value of the lobe over the probability of its choice
    alive: mi.Bool
    by_delta: mi.Bool
    through: mi.Bool  # by the one that leads through the surface
    probability: mi.Float  # with which one of two was chosen, else 1
    rest: mi.Float  # the number that chose, within the interval of what it chose: uniform again
    η: mi.Float  # index of refraction behind the surface over that before it; 1 where it is not led through


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
    si: mi.SurfaceInteraction3f,
    k: mi.UInt32,
    u: mi.Point2f,
    fixed: Direction | None,
    active: mi.Bool,
    ctx: mi.BSDFContext,
) -> Leaving:
    """Go on from vertex `k`: in the `fixed` direction, or by a delta lobe; `u` chooses. `ctx` tells what is carried.

    `fixed`: None where no surface scatters light.
    """
    if fixed is None:
        return _delta_leave(si, ctx, u.y, active)
    bsdf = si.bsdf()
    smooth, share = smooth_choice(bsdf, k, u.x)
    smooth &= active
    onward = _delta_leave(si, ctx, u.y, active & ~smooth)
    if ctx.mode == mi.TransportMode.Importance:
        f = particle_eval(si, bsdf, fixed.ω, smooth)
    else:
        f = bsdf.eval(ctx, si, si.to_local(fixed.ω), smooth)
    ray = dr.select(smooth, si.spawn_ray(fixed.ω), onward.ray)
    factor = dr.select(smooth, f * dr.select(fixed.pdf > 0, dr.rcp(fixed.pdf), 0), onward.factor) / share
    alive = (smooth & dr.any(factor != 0)) | onward.alive
    return replace(onward, ray=ray, factor=factor, alive=alive)


def lobes_part(
    ends: tuple[mi.SurfaceInteraction3f, mi.SurfaceInteraction3f],
    onward: tuple[Leaving, Leaving],
    numbers: tuple[mi.Float, mi.Float],
) -> tuple[mi.Bool, mi.Float]:
    """Do two chains leave by different delta lobes, and at which share of the way from the one to the other does the
    choice change, roughly? `numbers`: those that chose, of which the reflected lobe has the lowest.

    What is led through changes about evenly with x = cos θ on the thinner side, and x² with the place, but for total
    reflection: where that begins x is 0, and the probability jumps to 1.
    """
    a, b = onward
    η = dr.select(a.through, a.η, b.η)
    (x2_a, past_a), (x2_b, past_b) = (_past(*end, η) for end in zip(ends, onward, numbers, strict=True))
    t = past_a / (past_a - past_b)
    x_a, x_b = dr.safe_sqrt(x2_a), dr.safe_sqrt(x2_b)
    x = dr.lerp(x_a, x_b, t)
    apart = (x2_a < 0) | (x2_b < 0)  # elsewhere without differences of what is nearly equal
    share = dr.select(apart, (x2_a - dr.square(x)) / (x2_a - x2_b), t * (x_a + x) / (x_a + x_b))
    return a.by_delta & b.by_delta & (a.through != b.through), share


def _past(si: mi.SurfaceInteraction3f, leaving: Leaving, u: mi.Float, η: mi.Float) -> tuple[mi.Float, mi.Float]:
    """`(x², negative in total reflection; by how much u is past the probability of reflection)`: there, past the one
    where total reflection begins.
    """
    sin2 = mi.Frame3f.sin_theta_2(si.wi)
    x2 = 1 - dr.select(η < 1, sin2 / dr.square(η), sin2)
    past = u - dr.select(leaving.through, 1 - leaving.probability, leaving.probability)
    return x2, dr.select(x2 < 0, dr.minimum(u - (1 - LEAST_LOBE), 0), past)


def _delta_kinds(bsdf: mi.BSDFPtr) -> tuple[mi.Bool, mi.Bool]:
    """`(does it reflect, does it let through)` by a delta lobe."""
    flags = bsdf.flags()
    passes = mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) | mi.has_flag(flags, mi.BSDFFlags.Null)
    return mi.has_flag(flags, mi.BSDFFlags.DeltaReflection), passes


def _delta_leave(si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext, u: mi.Float, active: mi.Bool) -> Leaving:
    """By the reflected lobe or the one that leads through, as the random number `u` has it.

    Where one of two lobes is not there, such as in total reflection, every choice leads to the other one.
    """
    bsdf = si.bsdf()
    reflects, passes = _delta_kinds(bsdf)
    two = reflects & passes
    number = dr.select(u < LEAST_LOBE, FIRST_LOBE, (u - LEAST_LOBE) / (1 - 2 * LEAST_LOBE))
    number = dr.select(two, dr.minimum(number, LAST_LOBE), dr.select(passes, mi.Float(LAST_LOBE), FIRST_LOBE))
    bs, weight = bsdf.sample(ctx, si, number, mi.Point2f(0.5), active & (reflects | passes))
    crosses = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) < 0
    through = passes & (~reflects | crosses)
    there = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (bs.pdf > 0) & (crosses == through)
    null = there & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    value = dr.select(null, bsdf.eval_null_transmission(si, null), weight * bs.pdf)
    probability = dr.select(two & (bs.pdf < 1), LEAST_LOBE + (1 - 2 * LEAST_LOBE) * bs.pdf, 1)
    alive = there & dr.any(value != 0)
    ray = si.spawn_ray(si.to_world(bs.wo))
    factor = dr.select(alive, value / probability, 0)
    rest = dr.clip((u - dr.select(through, 1 - probability, 0)) / probability, 0, ALMOST_ONE)
    η = dr.select(through & there, bs.eta, 1)
    return Leaving(ray, factor, alive, alive, through, probability, rest, η)
