"""The boundary seen through mirrors and glass: steps of what is seen along a chain of delta vertices from the sensor.

In a mirror or behind glass an edge cannot be connected to the sensor: no closed form says where on the film it is seen.
The film is searched instead. Along a horizontal or vertical line X on it the view steps where two neighbouring camera
rays, followed along their paths, part (`chain_search`). The curve that is crossed there (`chain_outline`) is met by the
last line of sight where F(X, θ) = 0, so the crossing moves by Ẋ = −F_θ/F_X, and the derivative of the image receives

    h(p) · (L_a − L_b) · Ẋ / (lines per pixel),        a before b along the line,

with radiances L, the means of several walks with common random numbers, times the throughput of the path. A line along
the curve would make 1/F_X blow up: with lines in both directions and the weights F_x²/(F_x² + F_y²) and F_y²/(F_x² +
F_y²) what is left is −F_θ F_X/(F_x² + F_y²). F_x, F_y and F_θ are derivatives of one attached path (`chain_sweeps`);
the sensor is attached as well. No virtual camera, no root search, no count of solutions: as the path begins at the
film, all of that is settled by tracing it. Steps of the first segment belong to `primary`, and so do horizons of
mirrors that end it (`edges.kind_mirror_horizon`); paths that leave their first vertex by a smooth lobe belong to the
other terms.

Behind the first vertex any segment may step: what a mirror shows, the shadow on it (a shadow ray towards a point of
light that stays on its material), what its surfaces see of others (directions that stay what they are). Between smooth
vertices that is the spatial form with its directions and points of light drawn beforehand (`chain_fixed`). Seen are
outlines, creases, curves along which surfaces cut (both sides a little off them, `chain_beside`), shading
outlines and patterns. Left out is what lies behind more than `chain_world.CHAIN_DEPTH` segments, and the steps that
lights bring along. With light subpaths, what points send to the film by way of mirrors and glass steps as well, and is
searched from the light's side (`light_chain`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, tangents
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.streams import Stream, stream_seed
from ..edges.followed_lights import is_followed
from ..options import Options
from ..paths.surface_at import surface_at
from ..paths.walk import NoSink, walk
from ..plan.job import Job, passes
from ..plan.motion import Displacements
from ..plan.plan import Geometry
from ..plan.reasons import steps_rest
from ..plan.term import Term, Verdict
from ..scene.facts import SceneFacts
from . import light_chain
from .chain_beside import beside_curve
from .chain_crossing import adjoint_of_speed, crossings, sampled_as_edge, step_per_slope
from .chain_fixed import Directions, LightPoint
from .chain_lines import Lines
from .chain_outline import Curve
from .chain_search import find_crossings
from .chain_sweeps import adjoints_at_start, slope_at_end
from .chain_trace import ChainRecords, Pair
from .chain_world import CHAIN_DEPTH

NAME = "chain"

#: Walks on either side of a crossing. The search for it traces some 150 segments: they cost a few percent, and where
#: mirrors show what scatters light there is 1.4 to 11 times less noise with 4 than with one.
WALKS = 8

#: Memory of what one walk brings: a colour.
WALK_BYTES = 4 * 3

#: Memory of one line: an interval, its comparison, its share of what is found, what its walks bring, its directions.
BYTES = 256 + 2 * WALKS * WALK_BYTES + CHAIN_DEPTH * Directions.BYTES


@dataclass
class Steps:
    """Crossings, ready to be moved; one entry each, detached."""

    p: mi.Point2f  # film position [px]
    film: mi.Point2f  # the same in [0, 1]² of the crop window
    aperture: mi.Point2f
    end: End
    value: mi.Spectrum  # contribution per unit of F_θ
    wavelengths: mi.Color0f
    valid: mi.Bool


@dataclass
class End:
    """The last line of sight of chains, which the crossed curve is on. Detached."""

    segment: mi.UInt32  # its number
    curve: Curve
    in_light: mi.Bool  # it is a shadow ray
    light: LightPoint
    source: Hit  # of a shadow ray that is not blocked: its end on an area light
    distance: mi.Float  # of the light; infinite for directions

    def attached_F(self, o: mi.Point3f, d: mi.Vector3f, moving: Displacements, facts: SceneFacts) -> mi.Float:
        """F of the attached line of sight; a shadow ray follows its ends, in place of the direction `d`."""
        line = self.curve.line
        moved = dr.select(self.in_light, moving.of_surface(self.source), 0)
        turned = mi.Vector3f(0)
        if facts.has_delta_emitters:
            it = dr.zeros(mi.Interaction3f)
            it.p = line.o
            delta = self.in_light & mi.has_flag(self.light.pointer().flags(), mi.EmitterFlags.Delta)
            of_place, of_direction = moving.of_light(self.light.pointer(), it, delta)
            moved = dr.select(delta, of_place, moved)
            turned = dr.select(delta, of_direction, 0)
        near = dr.isfinite(self.distance)
        r = dr.select(near, self.distance, 1)
        aimed = line.d + dr.select(near, (moved - (o - dr.detach(o))) / r, turned)
        d = dr.select(self.in_light, dr.normalize(aimed), d)
        return self.curve.attached_F(o, d, moving, facts)


def _radiances(job: Job, pair: Pair, wavelengths) -> mi.Spectrum:
    """L_a − L_b: what arrives along the segments that part, times the chains' throughputs; a mean of `WALKS`."""
    n = dr.width(pair.k)
    index = dr.arange(mi.UInt32, 2 * WALKS * n)
    second, walked = (index & 1) == 1, index >> 1
    i = walked // WALKS
    of = dr.gather(Pair, pair, i)
    hit, β = dr.select(second, of.b, of.a), dr.select(second, of.β_b, of.β_a)
    rng = lane_sampler(stream_seed(job.seed, Stream.CHAIN_RADIANCE), walked)
    ray = mi.Ray3f(hit.o, hit.d, 0, dr.gather(type(wavelengths), wavelengths, i))
    limits = job.limits_beside.beyond(of.k)
    pi = hit.intersection()
    emits = of.emits | is_followed(job, pi.shape.emitter(), pi.is_valid())
    L, _, _ = walk(job.scene, rng, ray, pi, limits, NoSink(), emits, ~of.in_light)
    of_walk = dr.select(second, -L, L) * β / WALKS
    dr.eval(of_walk)  # of each channel by itself, the walks would be taken again
    step = dr.block_reduce(dr.ReduceOp.Add, of_walk, 2 * WALKS)
    return job.call.counters.rejected.keep_finite(step)


def _light_step(job: Job, pair: Pair, chain: ChainRecords, wavelengths) -> tuple[mi.Spectrum, Hit, mi.Float]:
    """Of shadow rays: `(L_a − L_b times the path's throughput, the one that is not blocked, its length)`."""
    hit = chain.segment(pair.k, pair.in_light)
    ray = mi.Ray3f(hit.o, hit.d, 0, wavelengths)
    si = surface_at(job.surfaces, hit.intersection(), ray, mi.RayFlags.All, pair.in_light)
    source = dr.select(pair.seen, pair.a, pair.b)
    towards = pair.light.towards(si, pair.in_light)
    value = pair.light.scattered(si, towards, source, pair.in_light) * dr.select(pair.seen, 1, -1) * pair.β_a
    infinite = mi.has_flag(pair.light.pointer().flags(), mi.EmitterFlags.Infinite)
    distance = dr.select(infinite, dr.inf, towards[0].dist)
    return job.call.counters.rejected.keep_finite(dr.select(pair.in_light, value, 0)), source, distance


def _steps(job: Job) -> tuple[Steps, ChainRecords] | None:
    """Everything about the crossings but how fast they move; None if there are none."""
    lines = Lines.of(job)
    found = find_crossings(lines)
    if found is None:
        return None
    chain, pair, curve = crossings(lines, found)
    line = lines.line(found.at.sample)
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), line.wavelength)
    lit, source, distance = _light_step(job, pair, chain, wavelengths)
    pair = beside_curve(lines.world, pair, curve)
    ΔL = (_radiances(job, pair, wavelengths) + lit) * weight
    end = End(pair.sight, curve, pair.in_light, pair.light, source, distance)

    p = line.at(found.at.lo)
    valid, step = step_per_slope(lines, chain, end, (p, line), lambda q: _first(lines, chain, line, q))
    if lines.world.surfaces.horizons:
        valid &= ~sampled_as_edge(lines.world, pair, curve.line)
    per_F = dr.select(valid, step * found.at.weight / lines.per_pixel(found.at.sample), 0)
    steps = Steps(p, lines.film(p), line.aperture, end, ΔL * per_F, wavelengths, valid)
    dr.eval(steps)
    return steps, chain


def _first(lines: Lines, chain: ChainRecords, line, q: mi.Point2f) -> tuple[mi.Point3f, mi.Vector3f]:
    """The first segments at the film position q, attached to it: their starts and directions."""
    ray, _ = lines.job.sensor.sample_ray(0, line.wavelength, lines.film(q), line.aperture)
    first = chain.segment(mi.UInt32(0), mi.Bool(True))
    return ray.o + ray.d * dr.detach(dr.dot(first.o - ray.o, ray.d)), ray.d


def _camera(moving, steps: Steps, chain: ChainRecords) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The motion of the camera rays at fixed film positions: of their starts and directions, attached."""
    first = chain.segment(mi.UInt32(0), mi.Bool(True))
    start = moving.of_camera(steps.film, steps.aperture, first.o)
    return start, moving.of_view(steps.film, steps.aperture, first.d)


def forward(job: Job) -> mi.TensorXf:
    """Derivative image along the tangents set on the scene's parameters. Detached."""
    image = films.black(job.film)
    with dr.suspend_grad():
        for share, part in passes(job, BYTES):
            found = _steps(part)
            if found is None:
                continue
            steps, chain = found
            camera = mi.Vector3f(0), mi.Vector3f(0)
            if job.facts.view_moves:
                with job.motion.attached() as moving:
                    camera = tangents(*_camera(moving, steps, chain))
            F_grad = slope_at_end(job.facts, chain, steps.end, camera, job.motion)
            image += share * _splat(job, steps, job.call.counters.rejected.keep_finite(steps.value * F_grad))
        if job.light is not None:
            image += light_chain.forward(job.with_film_at_rest())
    return image


def _splat(job: Job, steps: Steps, value: mi.Spectrum) -> mi.TensorXf:
    """The first surface is the same on both sides, and so is the coverage of the film."""
    return films.develop_boundary(job.film, steps.p, value, mi.Float(0), steps.wavelengths, steps.valid)


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters."""
    rejected = job.call.counters.rejected
    with dr.suspend_grad():
        for share, part in passes(job, BYTES):
            found = _steps(part)
            if found is None:
                continue
            steps, chain = found
            count = dr.width(steps.end.segment)
            λ = share * adjoint_of_speed(lambda F_θ: _splat(job, steps, steps.value * F_θ), count, grad_in)
            λ = rejected.keep_finite(mi.Color1f(λ)).x
            λ_o, λ_d = adjoints_at_start(part.facts, chain, steps.end, λ, job.motion, rejected)
            if job.facts.view_moves:
                with job.motion.attached() as moving:
                    start, direction = _camera(moving, steps, chain)
                    accumulate(dr.dot(λ_o, start) + dr.dot(λ_d, direction))
            dr.eval()
        if job.light is not None:
            light_chain.backward(job.with_film_at_rest(), grad_in)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Something must be seen through a delta lobe, and move."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if not facts.has_delta_lobes:
        return False, "no surface is a mirror, smooth glass or a window: everything is seen directly"
    if options.depth_limit < 2:
        return False, f"max_depth = {options.max_depth}: nothing is seen through mirrors and glass"
    return True, "outlines move in mirrors and behind glass"


def cost(form: str, sky: bool) -> float:
    """Time of a line relative to a path of the interior term: 4.1 before a ball of glass alone, 4.2 in a Cornell box of
    which a mirror moves, 9 where its glass ball does, which changes few paths of the interior (64², 64 spp, two cores).
    """
    return 4.5


TERM = Term(
    name=NAME,
    budget="spps",
    streams=(Stream.CHAIN_LINE, Stream.CHAIN_LOBES, Stream.CHAIN_GUIDE, Stream.CHAIN_CUTS, Stream.CHAIN_RADIANCE,
             Stream.LIGHT_CHAIN, Stream.LIGHT_CHAIN_PILOT),
    needed=needed,
    cost=cost,
    with_light=2.0,  # 3 beside a ball of glass, seen directly
    forward=forward,
    backward=backward,
    over_film=True,
    # .18 to .28 where mirrors and glass are moved, by processor time. The whole budget of a call follows from it: at
    # .23 calls take an eighth longer, for as much less noise.
    cost_of_segment=0.4,
)
