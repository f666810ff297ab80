"""Lines through edge points in the middle of a path: what both forms of the indirect boundary term start from.

Sample x_B on an edge and a direction ω in which the edge can matter; the line through it meets the receiver x_D on one
side and what is seen just past the edge on the other. Measure: edge length × solid angle at x_B. Detached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.sensor_frame import SensorFrame, View
from ..core.streams import Stream, stream_seed
from ..edges.curves import PIECES, CurveRows, attached_to_world, curve_point, local_viewpoint, transform_point
from ..edges.points import CURVE_LEAD, EdgePoint, clearance, contour_side, segment_position
from ..edges.rows import EdgeRows
from ..edges.table import compact, edge_samples
from ..paths.recording import RadianceByDepth
from ..paths.walk import walk
from ..plan.job import Job
from ..sampling.directions import wedges
from ..sampling.distribution import pmf, sample_edge, stratified
from ..sampling.relevance import SecondaryEdges
from .sensor_subpath import UNLIMITED_VERTICES, SubpathRecords, recorded_vertices


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

    def point(self) -> EdgePoint:
        """x_B as x_D sees it."""
        seen = View(mi.Point2f(0), mi.Point2f(0), self.x - self.r * self.ω, self.ω, self.r, mi.Float(0), mi.Bool(True))
        return EdgePoint(self.x, seen, self.side, mi.Float(1), mi.Bool(True))


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


def _line_on_segment(edges: SecondaryEdges, wedges_of, row, t, u, active) -> _Line:
    e = dr.gather(EdgeRows, edges.table.segments.rows, row, active)
    x, dx = segment_position(edges.table.segments, row, t, active)
    w = wedges_of(e)
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


def sample_views(job: Job, frame: SensorFrame, edges: SecondaryEdges, wedges_of=wedges) -> EdgeView:
    """Lines through edge points that end on a receiver; `wedges_of(rows)`: directions that count at straight edges."""
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
        line = _line_on_segment(edges, wedges_of, row, t, u, straight)
    if table.has_curves:
        on_curve = _line_on_curve(edges, row, t, u, ~straight)
        line = on_curve if line is None else dr.select(straight, line, on_curve)

    # A tangent line starts beside a curved surface, not on it.
    beside = dr.select(straight, 0, clearance(line.x, line.scale, table.centre)[0]) * line.side
    ω, side, pdf = line.ω, line.side, line.pdf_sa
    down = mi.Ray3f(line.x + beside - line.lead * ω, -ω, 0, wavelengths)
    pi = job.scene.ray_intersect_preliminary(down, coherent=False, active=line.valid)
    if job.scene.environment() is not None and job.form == "spatial":
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
        weight=weight * (line.across / (pmf(dist, row) * pdf * dr.opaque(mi.Float, count))),
        wavelengths=wavelengths,
    )
    return compact(view, line.valid & pi.is_valid())


def slots(records: SubpathRecords, kept: mi.UInt32) -> mi.UInt32:
    """By lane: its number among those `kept`."""
    slot = dr.zeros(mi.UInt32, records.lanes)
    dr.scatter(slot, dr.arange(mi.UInt32, dr.width(kept)), kept)
    return slot


def radiance_by_depth(job: Job, ray: mi.Ray3f, pi, lane: mi.UInt32, vertices: int, active: mi.Bool):
    """Radiance along `ray` without what its first vertex emits, by depth: `(by_depth, of the whole path)`.

    `lane`: picks the random numbers.
    """
    rng = lane_sampler(stream_seed(job.seed, Stream.INDIRECT_RADIANCE), lane)
    by_depth = RadianceByDepth(dr.width(lane), vertices)
    limits = replace(job.limits, max_depth=vertices)
    final, _, _ = walk(job.scene, rng, ray, pi, limits, by_depth, mi.Bool(False), active)
    dr.eval(final, by_depth.values, by_depth.reached)
    return by_depth, final


def longest_subpath(job: Job) -> int:
    """Vertices from the sensor to the receiver, at most: the edge's side and an emitter take a segment each."""
    return recorded_vertices(job, job.options.max_depth - 2 if job.options.max_depth != -1 else UNLIMITED_VERTICES)
