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

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..analytic_edges import (
    PIECES,
    CurveRows,
    attached_to_world,
    curve_point,
    local_viewpoint,
    transform_point,
)
from ..edge_distribution import pmf, sample_edge, stratified
from ..edge_rows import EdgeRows
from ..job import Job
from ..low_discrepancy import lane_sampler
from ..path_records import RadianceByDepth
from ..path_steps import walk
from ..records import Hit
from ..sensor_frame import SensorFrame, View
from ..streams import Stream, stream_seed
from . import secondary
from .edge_directions import wedge_measure, wedges
from .edge_points import (
    CURVE_LEAD,
    EdgePoint,
    clearance,
    contour_side,
    segment_position,
)
from .edges import EdgeTable, compact, edge_samples, shared_frame, sides
from .relevance import SecondaryEdges, secondary_edges
from .secondary import BoundarySamples
from .sensor_subpath import UNLIMITED_VERTICES, SubpathRecords, subpaths


@dataclass
class EdgeView:
    """A line through an edge point, with the receiver that sees it; detached, one entry per kept sample."""

    row: mi.UInt32
    t: mi.Float
    lane: mi.UInt32
    local: mi.Point3f  # on a curve: x_B in object space
    scale: mi.Float  # on a curve: size of the shape
    x: mi.Point3f  # x_B
    ω: mi.Vector3f  # from x_D to x_B
    side: mi.Vector3f  # s
    receiver: Hit  # x_D as the end of a ray from x_B
    r: mi.Float  # |x_B − x_D|
    weight: mi.Spectrum  # |τ×ω| / (pdf · number of samples)
    wavelengths: mi.Color0f


@dataclass
class _Line:
    """A line through an edge point. Detached."""

    x: mi.Point3f
    local: mi.Point3f
    scale: mi.Float
    ω: mi.Vector3f
    side: mi.Vector3f
    across: mi.Float  # |dx/dt × ω|
    pdf_sa: mi.Float
    pdf_reversed: mi.Float  # per solid angle, of −ω
    lead: mi.Float
    valid: mi.Bool


def _line_on_segment(edges: SecondaryEdges, row, t, u, active) -> _Line:
    e = dr.gather(EdgeRows, edges.table.segments.rows, row, active)
    x, dx = segment_position(edges.table.segments, row, t, active)
    w = wedges(e)
    ω = edges.sample_view(e, w, row, x, u, active)
    pdf, pdf_reversed = (edges.pdf_view(e, w, row, x, d, active) for d in (ω, -ω))
    side = dr.cross(dx, ω)
    across = dr.norm(side)
    side = dr.select(across > 0, side / across, 0)
    _, lead = clearance(x, dr.norm(dx), edges.table.centre, e.blur)
    valid = active & (across > 0) & (pdf > 0)
    return _Line(x, mi.Point3f(0), mi.Float(0), ω, side, across, pdf, pdf_reversed, lead, valid)


def _line_on_curve(edges: SecondaryEdges, row, t, u, active) -> _Line:
    """For a contour take the direction first: parallel lines of direction ω touch a surface along one contour."""
    table = edges.table
    rows = dr.gather(CurveRows, table.curves.rows, row - table.segment_count, active)
    columns = tuple(dr.detach(c) for c in attached_to_world(table.curves.shapes, rows.shape))
    ω = mi.warp.square_to_uniform_sphere(u)
    local = curve_point(rows.kind, rows.start + t / PIECES, local_viewpoint(columns, mi.Vector4f(-ω.x, -ω.y, -ω.z, 0)))
    x = mi.Point3f(transform_point(columns, local.x))
    side, across, scale = contour_side(columns, local, ω)
    valid = active & local.valid & (across > 0)
    pdf = mi.Float(dr.inv_four_pi)
    return _Line(x, local.x, scale, ω, side, across, pdf, pdf, CURVE_LEAD * scale, valid)


def sample_views(job: Job, frame: SensorFrame, edges: SecondaryEdges) -> EdgeView:
    """Lines through edge points that end on a receiver."""
    table, dist = edges.table, edges.distribution
    count = edge_samples(job, frame, paths=2)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.INDIRECT_EDGE), lane)
    row, t = sample_edge(dist, stratified(count, rng.next_1d()))
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    u = rng.next_2d()
    straight = row < table.segment_count
    line = None
    if table.has_segments:
        line = _line_on_segment(edges, row, t, u, straight)
    if table.has_curves:
        on_curve = _line_on_curve(edges, row, t, u, ~straight)
        line = on_curve if line is None else dr.select(straight, line, on_curve)

    # A tangent line starts beside a curved surface, not on it.
    beside = dr.select(straight, 0, clearance(line.x, line.scale, table.centre)[0]) * line.side
    ω, side, pdf = line.ω, line.side, line.pdf_sa
    down = mi.Ray3f(line.x + beside - line.lead * ω, -ω, 0, wavelengths)
    pi = job.scene.ray_intersect_preliminary(down, coherent=False, active=line.valid)
    if job.scene.environment() is not None:
        # Lines of which one end escapes have their receiver at the other, whichever direction was drawn.
        up = mi.Ray3f(line.x + beside + line.lead * ω, ω, 0, wavelengths)
        other = job.scene.ray_intersect_preliminary(up, coherent=False, active=line.valid)
        open_end = ~(pi.is_valid() & other.is_valid())
        turn = ~pi.is_valid()
        ω, side = dr.select(turn, -ω, ω), dr.select(turn & straight, -side, side)
        down, pi = dr.select(turn, up, down), dr.select(turn, other, pi)
        pdf = dr.select(open_end, pdf + line.pdf_reversed, pdf)
    view = EdgeView(
        row=row,
        t=t,
        lane=lane,
        local=line.local,
        scale=line.scale,
        x=line.x,
        ω=ω,
        side=side,
        receiver=Hit.of(down, pi),
        r=pi.t + line.lead,
        weight=weight * (line.across / (pmf(dist, row) * pdf * count)),
        wavelengths=wavelengths,
    )
    return compact(view, line.valid & pi.is_valid())


def _step(job: Job, table: EdgeTable, view: EdgeView, records: SubpathRecords) -> mi.Spectrum:
    """L_− − L_+ for every recorded vertex, within the depth that its subpath leaves (flat, see `SubpathRecords`)."""
    lane, left = records.lane_of(), records.depth - records.vertex_of()
    # Whoever is not seen by the sensor need not be known.
    useful = records.connected()
    kept = dr.compress(useful)
    n = dr.width(kept)
    if n == 0:
        return dr.zeros(mi.Spectrum, dr.width(lane))
    slot = dr.zeros(mi.UInt32, records.lanes)
    dr.scatter(slot, dr.arange(mi.UInt32, n), kept)
    by_depth, final = _both_sides(job, table, dr.gather(EdgeView, view, kept), records.depth + 1)
    needed = dr.gather(mi.Bool, useful, lane)
    slot = 2 * dr.gather(mi.UInt32, slot, lane)
    minus, plus = (
        by_depth.up_to(left, slot + side, dr.gather(mi.Spectrum, final, slot + side, needed)) for side in (0, 1)
    )
    return dr.select(needed, minus - plus, 0)


def _both_sides(job: Job, table: EdgeTable, view: EdgeView, vertices: int):
    """Radiance from both sides of every edge point, by depth: `(by_depth, final)`, 2 lanes each (−, +)."""
    n = dr.width(view.row)
    index = dr.arange(mi.UInt32, 2 * n)
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    seen = View(mi.Point2f(0), mi.Point2f(0), v.x - v.r * v.ω, v.ω, v.r, mi.Float(0), mi.Bool(True))
    point = EdgePoint(v.x, seen, v.side, mi.Float(1), mi.Bool(True))
    ray, pi, differs = sides(job.scene, table, v.row, v.t, point, v.scale, which, v.wavelengths)
    rng = lane_sampler(stream_seed(job.seed, Stream.INDIRECT_RADIANCE), v.lane)
    by_depth = RadianceByDepth(2 * n, vertices)
    limits = replace(job.limits, max_depth=vertices)
    final, _, _ = walk(job.scene, rng, ray, pi, limits, by_depth, mi.Bool(False), differs)
    dr.eval(final, by_depth.values, by_depth.reached)
    return by_depth, final


def longest_subpath(job: Job) -> int:
    """Vertices from the sensor to the receiver, at most: the edge's side and an emitter take a segment each."""
    return job.options.max_depth - 2 if job.options.max_depth != -1 else UNLIMITED_VERTICES


def _prepared(job: Job) -> BoundarySamples | None:
    """Sampled, traced and recorded; None if there is nothing to sample."""
    frame = shared_frame(job)
    edges = secondary_edges(job, lambda rows: wedge_measure(wedges(rows)), lights_count=False)
    if edges is None:
        return None
    table = edges.table
    view = sample_views(job, frame, edges)
    if dr.width(view.row) == 0:
        return None

    records = subpaths(
        job,
        frame,
        Stream.INDIRECT_SUBPATH,
        view.lane,
        view.receiver,
        view.wavelengths,
        view.weight,
        -view.side,
        longest_subpath(job),
    )
    value = job.rejected.keep_finite(records.data.W * _step(job, table, view, records))
    dr.eval(value)
    return BoundarySamples(
        table=table,
        row=view.row,
        t=view.t,
        local=view.local,
        n=view.side,
        wavelengths=view.wavelengths,
        records=records,
        value=value,
        source_motion=lambda: mi.Float(0),
    )


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the indirect boundary along the tangents set on the scene's parameters. Detached."""
    return secondary.forward(job, _prepared, longest_subpath(job))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the indirect boundary's ⟨grad_in, dI⟩ into the attached parameters."""
    secondary.backward(job, _prepared, longest_subpath(job), grad_in)
