"""Two neighbouring camera rays and the chains of delta vertices that they follow: where do they first part?

A chain goes on from a surface by one of its delta lobes and ends where there is none. Which lobe is a matter of random
numbers alone, the same for both chains and with the same probability wherever they are on a surface: nothing steps
because of the choice, and a chain's throughput is the product of the lobes' values over these probabilities. A surface
that also scatters smoothly (plastic) ends no chain. Total reflection leaves the transmitted lobe without a direction;
its value has gone to 0 before, so that a chain may end there without a step.

Two hits are on the same surface if a continuous path on it leads from the one to the other: the same plane where
shapes are flat, the same shape met from the same side, in front of its face and of its shading normal, elsewhere,
unless one point lies far off the other's tangent plane for their distance (a surface in front of itself) or their
normals differ (a crease). Such a guess may be wrong
for rays that are far apart, which costs time, and is right for those close by, which is what counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.varying import varying
from ..paths.delta_step import FIRST_LOBE, LAST_LOBE

#: Segments of a chain that are looked at; what is seen at the end of longer ones has no edges.
CHAIN_DEPTH = 8

#: Share of the chains that are reflected where a surface reflects and lets through.
REFLECTED_SHARE = 1 / 3

#: Flat surfaces: largest sine of the angle between planes that count as one, and their distance relative to the ray's.
COPLANAR_SINE, COPLANAR_OFFSET = 2e-4, 1e-4

#: Curved surfaces: offset of one point from the tangent plane of the other, relative to their distance, and difference
#: of the normals from which on they count as apart.
STEP_SLOPE, STEP_NORMAL = 0.25, 0.3


@dataclass(frozen=True)
class ChainWorld:
    """What chains are traced in. Host object."""

    scene: mi.Scene
    depth: int  # largest number of segments
    flat: mi.UInt32  # by registry index of a shape: 1 if its faces are shaded as planes


@dataclass
class Pair:
    """Where two chains part, or end together. Detached, one entry per lane; `a` and `b` are the two chains."""

    k: mi.UInt32  # number of the segment, 0: from the sensor
    differs: mi.Bool
    specular: mi.Bool  # some vertex on the way, or where they part, has a delta lobe
    a: Hit  # segment k of each
    b: Hit
    β_a: mi.Spectrum  # throughput before it
    β_b: mi.Spectrum


class ChainRecords:
    """Segments of the first chains of `lanes` pairs, segment-major. Not a PyTree, so never loop state."""

    def __init__(self, lanes: int, depth: int):
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.hits = Hit.made(dr.zeros, lanes * depth)
        dr.make_opaque(self.hits)

    def write(self, k: mi.UInt32, hit: Hit, active: mi.Bool) -> None:
        dr.scatter(self.hits, hit, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def segment(self, k: mi.UInt32, active: mi.Bool) -> Hit:
        """Segment `k` of every lane."""
        return dr.gather(Hit, self.hits, k * self.stride + self.lane, active)


@dataclass
class Leaving:
    """How a chain goes on."""

    ray: mi.Ray3f
    factor: mi.Spectrum  # value of the lobe over the probability of its choice
    alive: mi.Bool


def has_delta(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Does a chain go on there?"""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)


def leave(si: mi.SurfaceInteraction3f, u: mi.Float, active: mi.Bool) -> Leaving:
    """Go on by a delta lobe; `u` chooses between the reflected one and the one that leads through."""
    bsdf = si.bsdf()
    flags = bsdf.flags()
    reflects = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    passes = mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) | mi.has_flag(flags, mi.BSDFFlags.Null)
    through = passes & (~reflects | (u >= REFLECTED_SHARE))
    choice = dr.select(through, mi.Float(1 - REFLECTED_SHARE), REFLECTED_SHARE)
    choice = dr.select(reflects & passes, choice, 1)
    active = active & (reflects | passes)
    number = dr.select(through, mi.Float(LAST_LOBE), FIRST_LOBE)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, number, mi.Point2f(0.5), active)
    crosses = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) < 0
    alive = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (bs.pdf > 0) & (crosses == through)
    null = alive & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    value = dr.select(null, bsdf.eval_null_transmission(si, null), weight * bs.pdf)
    return Leaving(si.spawn_ray(si.to_world(bs.wo)), dr.select(alive, value / choice, 0), alive)


def same_surface(world: ChainWorld, a, b, d_a: mi.Vector3f, d_b: mi.Vector3f) -> mi.Bool:
    """Do two rays of directions d end on one continuous surface, or both escape? `a`, `b`: surface interactions."""
    both = a.is_valid() & b.is_valid()
    same = (a.shape == b.shape) & (a.is_valid() == b.is_valid())
    index = dr.select(both & same, dr.reinterpret_array(mi.UInt32, a.shape), 0)
    flat = dr.gather(mi.UInt32, world.flat, index) != 0
    offset = b.p - a.p
    side = dr.dot(a.n, d_a) * dr.dot(b.n, d_b) > 0
    near = COPLANAR_OFFSET * (a.t + b.t)
    one_plane = (dr.norm(dr.cross(a.n, b.n)) < COPLANAR_SINE) & (dr.dot(a.n, b.n) > 0)
    one_plane &= dr.abs(dr.dot(a.n, offset)) < near
    n_a, n_b = a.sh_frame.n, b.sh_frame.n
    off = dr.maximum(dr.abs(dr.dot(n_a, offset)), dr.abs(dr.dot(n_b, offset)))
    shaded = dr.dot(n_a, d_a) * dr.dot(n_b, d_b) > 0
    one_curve = side & shaded & (off < STEP_SLOPE * dr.norm(offset) + near) & (dr.norm(n_a - n_b) < STEP_NORMAL)
    return same & (~both | dr.select(flat, one_plane & side, one_curve))


@dr.syntax
def trace_pair(world: ChainWorld, ray_a: mi.Ray3f, ray_b: mi.Ray3f, rng, store: ChainRecords | None, active: mi.Bool):
    """Follow two chains as long as they meet the same surfaces; `store` keeps the segments of the first."""
    ray_a, ray_b = mi.Ray3f(ray_a), mi.Ray3f(ray_b)
    active = mi.Bool(active)
    pair = Pair(
        mi.UInt32(0), mi.Bool(False), mi.Bool(False), Hit.made(dr.zeros, 1), Hit.made(dr.zeros, 1),
        mi.Spectrum(1), mi.Spectrum(1)
    )  # fmt: skip
    while dr.hint(active, label="psdr.chain.pair", exclude=[world, store]):
        pi_a = world.scene.ray_intersect_preliminary(ray_a, coherent=False, active=active)
        pi_b = world.scene.ray_intersect_preliminary(ray_b, coherent=False, active=active)
        a = pi_a.compute_surface_interaction(ray_a, mi.RayFlags.All)
        b = pi_b.compute_surface_interaction(ray_b, mi.RayFlags.All)
        pair.a, pair.b = Hit.of(ray_a, pi_a), Hit.of(ray_b, pi_b)
        if dr.hint(store is not None, mode="scalar"):
            store.write(pair.k, pair.a, active)
        pair.differs = ~same_surface(world, a, b, ray_a.d, ray_b.d)
        pair.specular |= (a.is_valid() & has_delta(a.bsdf())) | (b.is_valid() & has_delta(b.bsdf()))
        u = rng.next_1d()
        active = ~pair.differs & a.is_valid() & (pair.k + 1 < world.depth)
        on_a, on_b = leave(a, u, active), leave(b, u, active)
        active = on_a.alive & on_b.alive
        pair.k += dr.select(active, mi.UInt32(1), 0)
        pair.β_a *= dr.select(active, on_a.factor, 1)
        pair.β_b *= dr.select(active, on_b.factor, 1)
        ray_a, ray_b = on_a.ray, on_b.ray
    return pair
