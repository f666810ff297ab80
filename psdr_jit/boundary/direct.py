"""Direct boundary: shadow edges, where an edge point x_B just lets light from x_S pass to a receiver x_D.

For every emitter point the shadow outline on the receivers is a discontinuity. Sample x_B on an edge (density per
length) and the emitter from x_B (density per solid angle there), follow the line backwards to x_D, and connect x_D to
the sensor:

    − L_e(x_S→x_D) · W · |τ×ω| · n_⊥·[ (v_B − u_D) − (r_B/r_S)(u_S − u_D) ] / pdf

ω from x_D to x_S, n_⊥ = ±τ×ω/|τ×ω| turned to the open side, r_B and r_S the distances of x_B and x_S from x_D, v_B the
edge's material velocity, u_S the emitter point's (the interior term keeps emitter points on their material:
`interior/flow.py`), u_D the sliding velocity of the receiver (`sensor_subpath.py`), W the importance at x_D. It is
the boundary integral of [Zhang et al. 2020, §5] with the segment's measure written at x_B. Limits of the same formula:
infinitely distant emitters have r_B/r_S = 0, and a directional light that turns adds −r_B n_⊥·ω̇; delta emitters
replace L_e dω by their intensity over distance².
Mitsuba starts rays a little above surfaces, and x_D is that of the ray which is the line (`lifted_receiver.py`).
Silhouettes only: an edge whose two faces lie on different sides of the line blocks it on both. Steps that a light
brings along itself, the frame of a picture or the rim of a cone, take a part of the samples (`light_steps.py`), and so
do the planes of coarse smooth-shaded faces, whether they are lit or shine (`horizons.py`, `light_horizons.py`). Lights
that touch what they shine on are left to the indirect term (`edges/followed_lights.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.compaction import compact
from ..core.line_guide import Drawn
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.streams import Stream, stream_seed
from ..edges.followed_lights import is_followed
from ..edges.kind import Use
from ..edges.location import EdgeLocation
from ..options import Options
from ..paths.smooth_lights import has_smooth_lights
from ..paths.walk import SHADOW_EPSILON
from ..plan.job import Job
from ..plan.motion import Displacements
from ..plan.plan import Geometry
from ..plan.reasons import NOTHING_SCATTERS, steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling.guided import guided
from ..sampling.horizons import horizon_weights
from ..sampling.light_horizons import light_horizon_weights
from ..sampling.light_steps import light_step_weights
from ..sampling.relevance import SecondaryEdges, line_weights, secondary_edges
from ..sampling.rows import edge_samples
from ..scene.facts import SceneFacts
from . import segment_motion
from .horizons import LIGHTS as HORIZONS
from .horizons import shared_out
from .lifted_receiver import Landing, ends_in_a_crease, lifted_receiver
from .light_horizons import LIGHT_HORIZONS
from .light_lines import LightLine, sample_light_lines
from .light_steps import BORNE
from .light_steps import ESTIMATOR as LIGHT_STEPS
from .segment_motion import BoundarySamples, SecondaryTerm
from .sensor_subpath import Receivers, longest_from_light, subpaths
from .towards_sensor import share_towards_sensor

NAME = "direct"

#: Under a sky, every direction leads to light and most lines to no receiver: they end after a ray or two, and as many
#: are drawn as make about one path per sample.
LINES_PER_PATH_UNDER_SKY = 2


@dataclass
class ShadowLine:
    """A line through an edge point and an emitter point, before its ends are known. Detached, one per sample."""

    lane: mi.UInt32
    row: mi.UInt32
    t: mi.Float
    light: LightLine
    pdf_row: mi.Float  # of row and t and by the guide, times the number of samples
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths
    drawn: Drawn


@dataclass
class BoundarySegment:
    """x_D ← x_B → x_S on one line; detached, one entry per kept sample."""

    lane: mi.UInt32
    at: EdgeLocation  # x_B
    ω: mi.Vector3f  # from x_D to x_S
    n_perp: mi.Vector3f  # to the open side
    emitter: mi.UInt32  # registry index
    source: Hit  # x_S as the end of a ray from x_B; no shape unless it lies on an area light
    receiver: Hit  # x_D as the end of a ray from x_B
    r: mi.Float  # |x_B − x_D|
    ratio: mi.Float  # r_B / r_S
    value: mi.Spectrum  # −L_e |τ×ω|
    pdf: mi.Float  # of the line, times the number of samples
    wavelengths: mi.Color0f
    drawn: Drawn


def sample(job: Job, edges: SecondaryEdges) -> ShadowLine:
    """Edge points, and emitter points on lines with them."""
    count = edge_samples(job, paths=1)
    if job.scene.environment() is not None:
        count *= LINES_PER_PATH_UNDER_SKY
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.DIRECT_EDGE), lane)
    jitter = rng.next_1d()
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    x, u, drawn = guided(job, count, jitter, rng.next_2d())
    row, t, pdf_row = edges.rows_at(x, count)
    light = sample_light_lines(job.scene, edges, row, t, wavelengths, u)
    return ShadowLine(lane, row, t, light, pdf_row * drawn.p, wavelengths, weight, drawn)


def trace(job: Job, edges: SecondaryEdges, line: ShadowLine) -> BoundarySegment | None:
    """The lines that end on a receiver and on a visible emitter; all others are left out (value 0)."""
    scene, light, on = job.scene, line.light, line.light.on
    active = light.valid & (light.pdf > 0) & dr.any(light.value != 0)
    active &= ~is_followed(job, light.emitter, active)

    # Towards the source: closest hit, so that the point on an area light can be attached.
    on_surface = mi.has_flag(light.emitter.flags(), mi.EmitterFlags.Surface)
    start = on.x + on.offset * light.n_perp + on.lead * light.ω
    up = mi.Ray3f(start, light.ω, 0, line.wavelengths)
    # Rays to a point light end a little before it, as Mitsuba's do: it may lie on a surface.
    up.maxt = dr.select(on_surface, dr.inf, (1 - SHADOW_EPSILON) * light.dist - on.lead)
    pi = scene.ray_intersect_preliminary(up, coherent=False, active=active)
    reached = pi.is_valid() & (pi.shape.emitter() == light.emitter)
    reached &= dr.abs(pi.t + on.lead - light.dist) < SHADOW_EPSILON * light.dist  # not another sheet of the emitter
    active &= dr.select(on_surface, reached, ~pi.is_valid())

    # Towards the receiver: from just above the edge, so that an edge resting on a surface ends there.
    down = mi.Ray3f(start, -light.ω, 0, line.wavelengths)
    met = Landing.of(job, down, active)
    # A contour's own surface may begin within its lead.
    active &= met.pi.is_valid() & ((on.aside == 0) | (met.pi.t - on.lead > on.offset))
    receiver, above, found = lifted_receiver(job, met, on.x, active)
    active &= found
    if job.facts.has_delta_emitters:
        face = edges.table.face_along(line.row, light.ω)
        active &= ~ends_in_a_crease(job, met, above, on, light.n_perp, face, active)
    r = dr.maximum(met.pi.t - on.lead - above, 0)

    infinite = mi.has_flag(light.emitter.flags(), mi.EmitterFlags.Infinite)
    segment = BoundarySegment(
        lane=line.lane,
        at=EdgeLocation(line.row, line.t, on.x, on.local, on.scale),
        ω=light.ω,
        n_perp=light.n_perp,
        emitter=dr.reinterpret_array(mi.UInt32, light.emitter),
        source=Hit.of(up, pi),
        receiver=receiver,
        r=r,
        ratio=dr.select(infinite, 0, r / (r + light.dist)),
        value=-light.value * line.weight * light.across,
        pdf=light.pdf * line.pdf_row,
        wavelengths=line.wavelengths,
        drawn=line.drawn,
    )
    return compact(segment, active)


def evaluate(job: Job, edges: SecondaryEdges, segment: BoundarySegment) -> BoundarySamples:
    """What the segments are worth at the sensor: their subpaths are recorded."""
    a = -(1 - segment.ratio) * segment.n_perp
    value, still = segment.value / segment.pdf, mi.Vector3f(0)
    if has_smooth_lights(job.facts):
        value *= _beside_samples_of_light(job, segment)
    receivers = Receivers(segment.lane, segment.receiver, segment.wavelengths, value, a, still)
    records = subpaths(job, Stream.DIRECT_SUBPATH, receivers, longest_from_light(job))
    value = records.left_by_smooth_lobes(records.data.W)
    return BoundarySamples.of(
        segment, records, value, lambda moving: source_motion(job, segment, moving), segment.drawn
    )


def _beside_samples_of_light(job: Job, segment: BoundarySegment) -> mi.Float:
    """R/ρ of `paths.smooth_lights`: lights are sampled as by Mitsuba here, which has ρ in it."""
    lit = segment.source.shape != 0
    R, ρ = share_towards_sensor(job, segment.receiver, segment.source.interaction(lit), segment.ω, lit)
    return R / ρ


def source_motion(job: Job, segment: BoundarySegment, moving: Displacements) -> mi.Float:
    """Attached −(r_B/r_S) n_⊥·x_S, or −r_B n_⊥·ω for a directional light: what the emitter contributes."""
    moved = -segment.ratio * dr.dot(segment.n_perp, moving.of_surface(segment.source))
    if job.facts.has_delta_emitters:
        emitter = dr.reinterpret_array(mi.EmitterPtr, segment.emitter)
        it = dr.zeros(mi.Interaction3f)
        it.p = segment.at.x
        it.wavelengths = segment.wavelengths
        delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        point, turn = moving.of_light(emitter, it, delta)
        at_infinity = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        by_turn = -segment.r * dr.dot(segment.n_perp, turn)
        by_place = -segment.ratio * dr.dot(segment.n_perp, point)
        moved += dr.select(delta, dr.select(at_infinity, by_turn, by_place), 0)
    return moved


SHADOWS = SecondaryTerm(
    edges=lambda job: secondary_edges(job, NAME, Use.SHADOW),
    longest=longest_from_light,
    sample=sample,
    trace=trace,
    evaluate=evaluate,
)


def parts(job: Job) -> list[tuple[SecondaryTerm, Job]]:
    """What the term consists of, each with its share of the samples: shadows, steps of lights, horizons of faces."""
    others = [SHADOWS]
    if has_smooth_lights(job.facts):
        others.insert(0, LIGHT_HORIZONS)
    if job.facts.has_light_steps:
        others.insert(0, LIGHT_STEPS)
        if job.light is not None and job.facts.has_delta_lobes:
            others.insert(0, BORNE)
    if len(others) == 1 and not any(shape.smooth for shape in job.facts.shapes):
        return [(SHADOWS, job)]
    return shared_out(job, HORIZONS, others)


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the term along the tangents set on the scene's parameters. Detached."""
    return sum((segment_motion.forward(share, part) for part, share in parts(job)), films.black(job.film))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; the transpose of `forward`, same samples."""
    for part, share in parts(job):
        segment_motion.backward(share, part, grad_in)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Some light, some receiver, and something between them."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if options.depth_limit < 2:
        return False, "max_depth = 1: nothing is lit, so nothing is in shadow"
    if not facts.scatters:
        return False, NOTHING_SCATTERS
    if facts.has_light_steps:
        return True, "shadows move, and so do steps that lights bring along"
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it casts no shadow on anything"
    if all(e.delta for e in facts.emitters):
        return True, "shadows move; every light is a point or a direction, so they are curves: one dimension less"
    return True, "shadows move"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    return 2.5 if sky else 1.1  # under a sky more lines are drawn than end on anything


TERM = Term(
    name=NAME,
    budget="sppd",
    streams=(
        Stream.DIRECT_EDGE,
        Stream.DIRECT_SUBPATH,
        Stream.LIGHT_STEP,
        Stream.LIGHT_STEP_SUBPATH,
        Stream.HORIZON,
        Stream.HORIZON_SUBPATH,
        Stream.LIGHT_HORIZON,
        Stream.LIGHT_HORIZON_SUBPATH,
    ),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(
        lambda job: (
            line_weights(job, Use.SHADOW)
            + light_step_weights(job)
            + horizon_weights(job, NAME, direct=True)
            + light_horizon_weights(job)
        ),
        "no light sees the others as an outline, or they are coplanar",
    ),
    guided=3,
)
