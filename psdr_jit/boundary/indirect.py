"""Indirect boundary: an edge x_B seen from a surface point x_D that is itself on the way to the sensor.

Sample x_B on an edge and a direction ω in which the edge can matter; the line through it meets the receiver x_D on one
side and what is seen just past the edge on the other. Measure: edge length × solid angle at x_B.

    (L_− − L_+) · W · |τ×ω| · s·(v_B − u_D) / pdf,        s = τ×ω/|τ×ω|

L_∓ are the radiances that x_D receives from beside the edge on the side −s and +s, *without* what the first vertex
emits (that is the direct term, in material form), traced with common random numbers. In the spatial form this covers
silhouettes as well as visible creases, borders and seams, of moving and of static shapes: a static edge moves in the
view of a sliding x_D. It is the boundary integral of [Zhang et al. 2020, §5], two-sided because directions, not
points, are kept.
The sensor subpath of m vertices leaves max_depth − 1 − m segments beyond the first vertex past the edge.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.streams import Stream
from ..edges.location import EdgeLocation
from ..edges.table import EdgeTable, shared_frame, sides
from ..options import Options
from ..plan.job import Job
from ..plan.plan import Geometry
from ..plan.reasons import steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling.directions import wedge_measure, wedges
from ..sampling.relevance import SecondaryEdges, secondary_edges
from ..scene.facts import SceneFacts
from . import indirect_material, segment_motion
from .edge_lines import EdgeView, longest_subpath, radiance_by_depth, sample_views, slots
from .segment_motion import BoundarySamples
from .sensor_subpath import Receivers, SubpathRecords, subpaths


def _step(job: Job, table: EdgeTable, view: EdgeView, records: SubpathRecords) -> mi.Spectrum:
    """L_− − L_+ for every recorded vertex, within the depth that its subpath leaves (flat, see `SubpathRecords`)."""
    lane, left = records.lane_of(), records.depth - records.vertex_of()
    # Whoever is not seen by the sensor need not be known.
    useful = records.connected()
    kept = dr.compress(useful)
    n = dr.width(kept)
    if n == 0:
        return dr.zeros(mi.Spectrum, dr.width(lane))
    slot = slots(records, kept)
    by_depth, final = _both_sides(job, table, dr.gather(EdgeView, view, kept), records.depth + 1)
    needed = dr.gather(mi.Bool, useful, lane)
    slot = 2 * dr.gather(mi.UInt32, slot, lane)
    minus, plus = (
        by_depth.up_to(left, slot + side, dr.gather(mi.Spectrum, final, slot + side, needed)) for side in (0, 1)
    )
    return dr.select(needed, minus - plus, 0)


def _both_sides(job: Job, table: EdgeTable, view: EdgeView, vertices: int):
    """Radiance from both sides of every edge point, by depth: `(by_depth, final)`, 2 lanes each (−, +)."""
    index = dr.arange(mi.UInt32, 2 * dr.width(view.row))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    ray, pi, differs = sides(job.scene, table, v.row, v.t, v.point(), v.scale, which, v.wavelengths)
    return radiance_by_depth(job, ray, pi, v.lane, vertices, differs)


def _spatial_edges(job: Job) -> SecondaryEdges | None:
    return secondary_edges(job, lambda rows: wedge_measure(wedges(rows)), lights_count=False)


def _prepared(job: Job) -> BoundarySamples | None:
    """Sampled, traced and recorded, in spatial form; None if there is nothing to sample."""
    frame = shared_frame(job)
    edges = _spatial_edges(job)
    if edges is None:
        return None
    table = edges.table
    view = sample_views(job, frame, edges)
    if dr.width(view.row) == 0:
        return None

    receivers = Receivers(view.lane, view.receiver, view.wavelengths, view.weight, -view.side)
    records = subpaths(job, frame, Stream.INDIRECT_SUBPATH, receivers, longest_subpath(job))
    value = job.call.counters.rejected.keep_finite(records.data.W * _step(job, table, view, records))
    dr.eval(value)
    return BoundarySamples(
        table=table,
        at=EdgeLocation(view.row, view.t, view.x, view.local, view.scale),
        n=view.side,
        wavelengths=view.wavelengths,
        records=records,
        value=value,
        source_motion=lambda moving: mi.Float(0),
    )


#: Which edges are sampled, and how the term is estimated, by form.
EDGES = {"spatial": _spatial_edges, "material": indirect_material.background_edges}
PREPARE = {"spatial": _prepared, "material": indirect_material.prepared}


def edge_weights(job: Job) -> mi.Float | None:
    """Density of edge samples by row of the edge table, not normalised; None if there is none."""
    edges = EDGES[job.form](job)
    return None if edges is None else edges.distribution.weight


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the indirect boundary along the tangents set on the scene's parameters. Detached."""
    return segment_motion.forward(job, PREPARE[job.form], longest_subpath(job))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the indirect boundary's ⟨grad_in, dI⟩ into the attached parameters."""
    segment_motion.backward(job, PREPARE[job.form], longest_subpath(job), grad_in)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Surfaces see each other, and something moves in their view."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if options.depth_limit < 3:
        return False, f"max_depth = {options.depth_limit}: light is scattered once at most"
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it sees nothing but the sky"
    if not (facts.shapes_move or facts.camera_moves):
        return False, "only lights without a shape move: what surfaces see of each other stays the same"
    return True, "what surfaces see of each other moves"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    return 0.6 if form == "material" else 0.9  # in material form one side of an edge is traced


TERM = Term(
    name="indirect",
    budget="sppi",
    streams=(Stream.INDIRECT_EDGE, Stream.INDIRECT_SUBPATH, Stream.INDIRECT_RADIANCE),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(edge_weights, "the others are coplanar, or lie inside of closed surfaces"),
)
