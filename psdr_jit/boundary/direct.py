"""Direct boundary: shadow edges, where an edge point x_B just lets light from x_S pass to a receiver x_D.

For every emitter point the shadow outline on the receivers is a discontinuity. Sample x_B on an edge (density per
length) and the emitter from x_B (density per solid angle there), follow the line backwards to x_D, and connect x_D to
the sensor:

    − L_e(x_S→x_D) · W · |τ×ω| · n_⊥·[ (v_B − u_D) − (r_B/r_S)(u_S − u_D) ] / pdf

ω from x_D to x_S, n_⊥ = ±τ×ω/|τ×ω| turned to the open side, r_B and r_S the distances of x_B and x_S from x_D, v_B the
edge's material velocity, u_S the emitter point's (the interior term keeps emitter points on their material:
`interior/sweeps.py`), u_D the sliding velocity of the receiver (`sensor_subpath.py`), W the importance at x_D. It is
the boundary integral of [Zhang et al. 2020, §5] with the segment's measure written at x_B. Limits of the same formula:
infinitely distant emitters have r_B/r_S = 0, and a directional light that turns adds −r_B n_⊥·ω̇; delta emitters
replace L_e dω by their intensity over distance².
Silhouettes only: an edge whose two faces lie on different sides of the line blocks it on both.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.sensor_frame import SensorFrame
from ..core.streams import Stream, stream_seed
from ..edges.location import EdgeLocation
from ..edges.rows import EdgeRows
from ..edges.table import compact, edge_samples, shared_frame
from ..options import Options
from ..paths.walk import SHADOW_EPSILON
from ..plan.job import Job
from ..plan.motion import Displacements
from ..plan.plan import Geometry
from ..plan.reasons import steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling.directions import silhouette_wedges, wedge_measure
from ..sampling.distribution import pmf, sample_edge, stratified
from ..sampling.relevance import SecondaryEdges, can_cast_shadow, secondary_edges
from ..scene.facts import SceneFacts
from . import segment_motion
from .light_lines import source_from_curve, source_from_segment
from .segment_motion import BoundarySamples
from .sensor_subpath import UNLIMITED_VERTICES, Receivers, recorded_vertices, subpaths

#: Under a sky, every direction leads to light and most lines to no receiver: they end after a ray or two, and as many
#: are drawn as make about one path per sample.
LINES_PER_PATH_UNDER_SKY = 2


@dataclass
class BoundarySegment:
    """x_D ← x_B → x_S on one line; detached, one entry per kept sample."""

    row: mi.UInt32
    t: mi.Float
    lane: mi.UInt32
    local: mi.Point3f  # on a curve: x_B in object space
    x: mi.Point3f  # x_B
    ω: mi.Vector3f  # from x_D to x_S
    n: mi.Vector3f  # n_⊥
    emitter: mi.UInt32  # registry index
    source: Hit  # x_S as the end of a ray from x_B; no shape unless it lies on an area light
    receiver: Hit  # x_D as the end of a ray from x_B
    r: mi.Float  # |x_B − x_D|
    ratio: mi.Float  # r_B / r_S
    value: mi.Spectrum  # −L_e |τ×ω| / (pdf · number of samples)
    wavelengths: mi.Color0f


def sample_segments(job: Job, frame: SensorFrame, edges: SecondaryEdges) -> BoundarySegment:
    """Boundary segments that end on a receiver and on a visible emitter; all others are left out (value 0)."""
    table, dist = edges.table, edges.distribution
    scene = job.scene
    count = edge_samples(job, frame, paths=1)
    if scene.environment() is not None:
        count *= LINES_PER_PATH_UNDER_SKY
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.DIRECT_EDGE), lane)
    row, t = sample_edge(dist, stratified(count, rng.next_1d()))
    it = dr.zeros(mi.Interaction3f, count)
    it.wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    u = rng.next_2d()
    straight = row < table.segment_count
    found = None
    if table.has_segments:
        found = source_from_segment(scene, edges, row, t, mi.Interaction3f(it), u, straight)
    if table.has_curves:
        on_curve = source_from_curve(scene, edges, row, t, mi.Interaction3f(it), u, ~straight)
        found = on_curve if found is None else dr.select(straight, found, on_curve)
    e, ds = found
    active = e.valid & (ds.pdf > 0) & dr.any(e.value != 0)

    # Towards the source: closest hit, so that the point on an area light can be attached.
    on_surface = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    start = e.x + e.offset * e.n + e.lead * e.ω
    up = mi.Ray3f(start, e.ω, 0, it.wavelengths)
    up.maxt = dr.select(on_surface, dr.inf, e.dist - e.lead)
    pi = scene.ray_intersect_preliminary(up, coherent=False, active=active)
    reached = pi.is_valid() & (pi.shape.emitter() == ds.emitter)
    reached &= dr.abs(pi.t + e.lead - e.dist) < SHADOW_EPSILON * e.dist  # the sampled point, not another sheet of it
    active &= dr.select(on_surface, reached, ~pi.is_valid())

    # Towards the receiver: from just above the edge, so that an edge resting on a surface ends there.
    down = mi.Ray3f(start, -e.ω, 0, it.wavelengths)
    pd = scene.ray_intersect_preliminary(down, coherent=False, active=active)
    r = pd.t - e.lead
    active &= pd.is_valid() & (r > dr.select(straight, e.lead, e.offset))

    infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    segment = BoundarySegment(
        row=row,
        t=t,
        lane=lane,
        local=e.local,
        x=e.x,
        ω=e.ω,
        n=e.n,
        emitter=dr.reinterpret_array(mi.UInt32, ds.emitter),
        source=Hit.of(up, pi),
        receiver=Hit.of(down, pd),
        r=r,
        ratio=dr.select(infinite, 0, r / (r + e.dist)),
        value=-e.value * weight * (e.across / (pmf(dist, row) * dr.opaque(mi.Float, count))),
        wavelengths=it.wavelengths,
    )
    return compact(segment, active)


def longest_subpath(job: Job) -> int:
    """Vertices from the sensor to the receiver, at most: one segment is left for the emitter."""
    return recorded_vertices(job, job.options.max_depth - 1 if job.options.max_depth != -1 else UNLIMITED_VERTICES)


def source_motion(job: Job, segment: BoundarySegment, moving: Displacements) -> mi.Float:
    """Attached −(r_B/r_S) n_⊥·x_S, or −r_B n_⊥·ω for a directional light: what the emitter contributes."""
    moved = -segment.ratio * dr.dot(segment.n, moving.of_surface(segment.source))
    if job.facts.has_delta_emitters:
        emitter = dr.reinterpret_array(mi.EmitterPtr, segment.emitter)
        it = dr.zeros(mi.Interaction3f)
        it.p = segment.x
        it.wavelengths = segment.wavelengths
        delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        point, turn = moving.of_light(emitter, it, delta)
        at_infinity = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        by_turn, by_place = -segment.r * dr.dot(segment.n, turn), -segment.ratio * dr.dot(segment.n, point)
        moved += dr.select(delta, dr.select(at_infinity, by_turn, by_place), 0)
    return moved


def _shadow_weight(job: Job, rows: EdgeRows) -> mi.Float:
    """Weight per length: the lune in which the edge is a silhouette, if a light can see it as one.

    Where two surfaces cut into each other both block the light: nothing passes such a curve.
    """
    casts = can_cast_shadow(job, rows) & (rows.junction == 0)
    return dr.select(casts, wedge_measure(silhouette_wedges(rows)), 0)


def _edges(job: Job) -> SecondaryEdges | None:
    return secondary_edges(job, lambda rows: _shadow_weight(job, rows), lights_count=True)


def edge_weights(job: Job) -> mi.Float | None:
    """Density of edge samples by row of the edge table, not normalised; None if there is none."""
    edges = _edges(job)
    return None if edges is None else edges.distribution.weight


def _prepared(job: Job) -> BoundarySamples | None:
    """Sampled, traced and recorded; None if there is nothing to sample."""
    frame = shared_frame(job)
    edges = _edges(job)
    if edges is None:
        return None
    segment = sample_segments(job, frame, edges)
    if dr.width(segment.row) == 0:
        return None
    a = -(1 - segment.ratio) * segment.n
    receivers = Receivers(segment.lane, segment.receiver, segment.wavelengths, segment.value, a)
    records = subpaths(job, frame, Stream.DIRECT_SUBPATH, receivers, longest_subpath(job))
    return BoundarySamples(
        table=edges.table,
        at=EdgeLocation(segment.row, segment.t, segment.x, segment.local, mi.Float(0)),
        n=segment.n,
        wavelengths=segment.wavelengths,
        records=records,
        value=records.data.W,
        source_motion=lambda moving: source_motion(job, segment, moving),
    )


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the direct boundary along the tangents set on the scene's parameters. Detached."""
    return segment_motion.forward(job, _prepared, longest_subpath(job))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the direct boundary's ⟨grad_in, dI⟩ into the attached parameters."""
    segment_motion.backward(job, _prepared, longest_subpath(job), grad_in)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Some light, some receiver, and something between them."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if options.depth_limit < 2:
        return False, "max_depth = 1: nothing is lit, so nothing is in shadow"
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it casts no shadow on anything"
    if all(e.delta for e in facts.emitters):
        return True, "shadows move; every light is a point or a direction, so they are curves: one dimension less"
    return True, "shadows move"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    return 2.5 if sky else 1.1  # under a sky more lines are drawn than end on anything


TERM = Term(
    name="direct",
    budget="sppd",
    streams=(Stream.DIRECT_EDGE, Stream.DIRECT_SUBPATH),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(edge_weights, "no light sees the others as an outline, or they are coplanar"),
)
