"""Two neighbouring camera rays and the paths that they follow: where do they first part?

A path leaves its first vertex by a delta lobe, and every other one by a delta lobe or in the direction that its line
keeps for it (`chain_fixed`). Which lobe is a matter of random numbers that the line keeps as well, and of the vertex
(`chain_lobes`): paths part where the choice changes, too, though what is seen does not step there. A path's throughput
is the product of the lobes' values over their probabilities.

Whether two hits are on the same surface, and whether two paths leave it to the same side, is told by `chain_surface`.
On the way, lamps are looked out for that may hide between the two (`chain_lamps`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.varying import varying
from ..paths.surface_at import surface_at
from .chain_fixed import Directions, LightPoint, draw_direction, draw_light
from .chain_lobes import Leaving, LobeNumber, has_delta, leave, lobes_part, smooth_choice
from .chain_patterns import NO_FAMILY
from .chain_surface import NOWHERE, goes_under
from .chain_world import ChainWorld


@dataclass
class Pair:
    """Where two chains part, or end together. Detached, one entry per lane; `a` and `b` are the two chains."""

    k: mi.UInt32  # number of the segment, 0: from the sensor
    differs: mi.Bool
    specular: mi.Bool  # some vertex on the way, or where they part, has a delta lobe
    chosen: mi.Bool  # they part by the choice of a lobe, which is no step of what is seen
    moves: mi.Bool  # something on the way, or where they part, can move: elsewhere a step stays where it is
    emits: mi.Bool  # does what segment k ends at count with its emission?
    in_light: mi.Bool  # they part in what they see of `light` from the end of segment k, which they share
    seen: mi.Bool  # it is the first that sees it
    horizon: mi.Bool  # they part as they leave what segment k − 1 ends at, ...
    one_face: mi.Bool  # ... and that is one face, not the edge between two
    turned: mi.Bool  # they part where the shading normal at the end of segment k turns away from the sensor
    family: mi.UInt32  # of lines on the surface, between which they part; `chain_patterns.NO_FAMILY`: they do not
    where: mi.Float  # between the chains that line lies: share of the way from a to b, roughly
    lamp: mi.Float  # where between them a lamp may hide, likewise, ...
    miss: mi.Float  # ... and how near to it they are thought to come [its radius]
    light: LightPoint
    a: Hit  # segment k of each, or the shadow rays from its end
    b: Hit
    β_a: mi.Spectrum  # throughput before it
    β_b: mi.Spectrum

    @staticmethod
    def start() -> Pair:
        """No two of its arrays may be one object: loops change them in place."""
        differs, specular, chosen, moves, in_light, seen = (mi.Bool(False) for _ in range(6))
        horizon, one_face, turned = (mi.Bool(False) for _ in range(3))
        light = LightPoint(mi.UInt32(0), mi.Point3f(0), mi.Point2f(0), mi.Float(0))
        a, b = (Hit.made(dr.zeros, 1) for _ in range(2))
        where, lamp, miss = mi.Float(0.5), mi.Float(0.5), mi.Float(dr.inf)
        family, β_a, β_b = mi.UInt32(NO_FAMILY), mi.Spectrum(1), mi.Spectrum(1)
        return Pair(mi.UInt32(0), differs, specular, chosen, moves, mi.Bool(True), in_light, seen, horizon, one_face,
                    turned, family, where, lamp, miss, light, a, b, β_a, β_b)  # fmt: skip

    @property
    def last(self) -> mi.UInt32:
        """Number of the segment whose ends part, shadow rays counted."""
        return self.k + dr.select(self.in_light, mi.UInt32(1), 0)

    @property
    def sight(self) -> mi.UInt32:
        """Number of the segment that the crossed curve is met by: before a horizon it is the last but one."""
        return self.last - dr.select(self.horizon, mi.UInt32(1), 0)


class ChainRecords:
    """Segments of the first chains of `lanes` pairs, segment-major. Not a PyTree, so never loop state."""

    def __init__(self, lanes: int, depth: int):
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.hits = Hit.made(dr.zeros, lanes * (depth + 1))  # behind the last vertex there may be a shadow ray
        self.bends = dr.zeros(mi.Bool, lanes * (depth + 1))  # is the end of the segment left by a delta lobe?
        dr.make_opaque(self.hits, self.bends)

    def write(self, k: mi.UInt32, hit: Hit, active: mi.Bool) -> None:
        dr.scatter(self.hits, hit, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def write_bend(self, k: mi.UInt32, by_delta: mi.Bool, active: mi.Bool) -> None:
        dr.scatter(self.bends, by_delta, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def segment(self, k: mi.UInt32, active: mi.Bool) -> Hit:
        """Segment `k` of every lane."""
        return dr.gather(Hit, self.hits, k * self.stride + self.lane, active)

    def bent(self, k: mi.UInt32, active: mi.Bool) -> mi.Bool:
        return dr.gather(mi.Bool, self.bends, k * self.stride + self.lane, active)


@dataclass
class Numbers:
    """Random numbers of one vertex, the same for all chains of a line."""

    lobe: mi.Point2f
    emitter: mi.Float
    light: mi.Point2f

    @staticmethod
    def draw(rng) -> Numbers:
        return Numbers(rng.next_2d(), rng.next_1d(), rng.next_2d())


@dr.syntax
def guide(world: ChainWorld, ray: mi.Ray3f, numbers: tuple, sampler, line: mi.UInt32, out: Directions):
    """Follow a chain of every line, draw the directions that it keeps. `numbers` as for `trace_pair`. Fills `out`."""
    ray, k, active = mi.Ray3f(ray), mi.UInt32(0), mi.Bool(True)
    rng, lobe = numbers[0], LobeNumber.begin(numbers[1])
    ctx = mi.BSDFContext(world.mode)
    while dr.hint(k < world.depth, label="psdr.chain.guide", exclude=[world, out, ctx]):
        pi = world.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si = surface_at(world.tables, pi, ray, mi.RayFlags.All, active)
        active &= si.is_valid()
        u = Numbers.draw(rng)
        smooth, _ = smooth_choice(si.bsdf(), k, u.lobe.x)
        fixed = draw_direction(si, sampler, smooth & active, world.aims)
        out.write(k, line, fixed)
        lobe = lobe.or_fresh(u.lobe.y)
        onward = leave(si, k, mi.Point2f(u.lobe.x, lobe.u), fixed, active, ctx)
        lobe = lobe.behind(onward, active)
        ray, active = onward.ray, onward.alive
        k += 1


@dr.syntax
def trace_pair(
    world: ChainWorld, rays: tuple[mi.Ray3f, mi.Ray3f], numbers: tuple, fixed: tuple, store: ChainRecords | None
):
    """Follow two chains as long as they meet the same surfaces; `store` keeps the segments of the first.

    `numbers`: a sampler, and the random number that chooses delta lobes, the same for all chains of a line. `fixed`:
    the directions of all lines, and the number of this one.
    """
    rng, lobe_a, lobe_b = numbers[0], LobeNumber.begin(numbers[1]), LobeNumber.begin(numbers[1])
    ray_a, ray_b = mi.Ray3f(rays[0]), mi.Ray3f(rays[1])
    (directions, line), ctx = fixed, mi.BSDFContext(world.mode)
    active, pair = mi.Bool(True), Pair.start()
    while dr.hint(active, label="psdr.chain.pair", exclude=[world, directions, store, ctx]):
        pi_a = world.scene.ray_intersect_preliminary(ray_a, coherent=False, active=active)
        pi_b = world.scene.ray_intersect_preliminary(ray_b, coherent=False, active=active)
        a = surface_at(world.tables, pi_a, ray_a, mi.RayFlags.All)
        b = surface_at(world.tables, pi_b, ray_b, mi.RayFlags.All)
        pair.a, pair.b = Hit.of(ray_a, pi_a), Hit.of(ray_b, pi_b)
        if dr.hint(store is not None, mode="scalar"):
            store.write(pair.k, pair.a, active)
        pair.differs = ~world.surfaces.same(a, b, ray_a.d, ray_b.d, pair.k)
        pair.horizon &= pair.differs
        if dr.hint(world.patterns is not None, mode="scalar"):
            guessed = active & ~pair.horizon
            crossed, family, where = world.patterns.crossed(a, b, active & ~pair.differs & a.is_valid())
            pair.differs |= crossed
            pair.family, pair.where = dr.select(active, family, pair.family), dr.select(guessed, where, pair.where)
        if dr.hint(world.lamps is not None, mode="scalar"):
            pair = look_for_lamps(world, pair, line, ((ray_a, a), (ray_b, b)), active)
        pair.differs &= world.differ(a, b, pair.k)
        pair.specular |= (a.is_valid() & has_delta(a.bsdf())) | (b.is_valid() & has_delta(b.bsdf()))
        pair.moves |= world.moves(a, b)
        u = Numbers.draw(rng)
        active = ~pair.differs & a.is_valid() & (pair.k + 1 < world.depth)

        direction = None
        if dr.hint(world.scatters, mode="scalar"):
            pair = world.connects(world, pair, (a, b), u, active & (pair.k > 0))
            active &= ~pair.differs
            direction = directions.read(pair.k, line, active)
        lobe_a, lobe_b = lobe_a.or_fresh(u.lobe.y), lobe_b.or_fresh(u.lobe.y)
        on_a = leave(a, pair.k, mi.Point2f(u.lobe.x, lobe_a.u), direction, active, ctx)
        on_b = leave(b, pair.k, mi.Point2f(u.lobe.x, lobe_b.u), direction, active, ctx)
        pair.chosen, place = lobes_part((a, b), (on_a, on_b), (lobe_a.u, lobe_b.u))
        pair.differs, pair.where = pair.differs | pair.chosen, dr.select(pair.chosen, place, pair.where)
        lobe_a, lobe_b = lobe_a.behind(on_a, active), lobe_b.behind(on_b, active)
        if dr.hint(store is not None, mode="scalar"):
            store.write_bend(pair.k, on_a.by_delta, active)
        active = on_a.alive & on_b.alive & ~pair.chosen & world.goes_on(pair.k, on_a.by_delta)
        if dr.hint(world.surfaces.horizons, mode="scalar"):
            pair = leave_to(pair, (a, b), (on_a, on_b), active)
        pair.k += dr.select(active, mi.UInt32(1), 0)
        pair.emits = dr.select(active, on_a.by_delta, pair.emits)
        pair.β_a *= dr.select(active, on_a.factor, 1)
        pair.β_b *= dr.select(active, on_b.factor, 1)
        ray_a, ray_b = on_a.ray, on_b.ray
    pair.moves |= world.camera | pair.chosen
    return pair


def look_for_lamps(world: ChainWorld, pair: Pair, line: mi.UInt32, ends: tuple, active: mi.Bool) -> Pair:
    """May a lamp hide between the chains' segments, nearer to them than what has been found so far?"""
    share, miss = world.lamps.between(line, *ends)
    nearer = active & pair.emits & (pair.k > 0) & (miss < pair.miss)
    return replace(pair, lamp=dr.select(nearer, share, pair.lamp), miss=dr.select(nearer, miss, pair.miss))


def compare_light(world: ChainWorld, pair: Pair, ends: tuple, u: Numbers, active: mi.Bool) -> Pair:
    """Do the chains see the same of a point of light, from the surface interactions `ends`?"""
    a, b = ends
    active = active & mi.has_flag(a.bsdf().flags(), mi.BSDFFlags.Smooth)
    light = draw_light(world.scene, u.emitter, u.light, active)
    if world.followed is not None:
        active &= ~world.followed.has(light.pointer(), active)
    hit_a, seen_a = light.seen_from(world.scene, a, active)
    hit_b, seen_b = light.seen_from(world.scene, b, active)
    parts = active & (seen_a != seen_b)
    return replace(
        pair,
        differs=pair.differs | parts,
        moves=pair.moves | (parts & (world.lights | world.moves(hit_a, hit_b))),
        in_light=parts,
        seen=seen_a,
        light=dr.select(parts, light, pair.light),
        a=dr.select(parts, hit_a, pair.a),
        b=dr.select(parts, hit_b, pair.b),
    )


def leave_to(pair: Pair, ends: tuple, onward: tuple[Leaving, Leaving], active: mi.Bool) -> Pair:
    """Do the chains leave their surfaces, whose interactions are `ends`, to the same side of the faces?"""
    (a, b), (ω_a, ω_b) = ends, (leaving.ray.d for leaving in onward)
    one_face = (a.shape == b.shape) & (a.prim_index == b.prim_index)
    horizon = active & (goes_under(a, ω_a) != goes_under(b, ω_b))
    h_a, h_b = dr.dot(a.n, ω_a), dr.dot(b.n, ω_b)
    where = dr.select(one_face & (h_a * h_b < 0), h_a / (h_a - h_b), NOWHERE)
    return replace(
        pair,
        horizon=dr.select(active, horizon, pair.horizon),
        one_face=dr.select(active, one_face, pair.one_face),
        where=dr.select(horizon, where, pair.where),
    )
