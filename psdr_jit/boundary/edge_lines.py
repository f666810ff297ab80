"""Lines through edge points in the middle of a path: what both forms of the indirect boundary term start from.

Sample x_B on an edge and a direction ω in which the edge can matter; the line through it meets the receiver x_D on one
side and what is seen just past the edge on the other. Measure: edge length × solid angle at x_B. Detached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.line_guide import Drawn
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.streams import Stream, stream_seed
from ..edges.followed_lights import followed_lights
from ..edges.kind import Line, OnEdge, Sight
from ..paths.bounce import PathLimits
from ..paths.rays import ROUNDING
from ..paths.recording import RadianceByDepth
from ..paths.walk import walk
from ..plan.job import Job
from ..sampling.guided import guided
from ..sampling.relevance import SecondaryEdges
from ..sampling.rows import edge_samples
from .lifted_receiver import Landing, lifted_receiver
from .sensor_subpath import UNLIMITED_VERTICES, SubpathRecords, recorded_vertices

#: Distance from an edge, in its step aside, at which lines to receivers start.
NEAR = 3.0


@dataclass
class EdgeLine:
    """A line through an edge point, before its ends are known. Detached, one entry per sample."""

    lane: mi.UInt32
    row: mi.UInt32
    t: mi.Float
    through: Line
    n_perp: mi.Vector3f
    across: mi.Float  # |dx/dt × ω| [m]
    pdf_row: mi.Float  # of row and t and by the guide, times the number of samples
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths
    drawn: Drawn
    valid: mi.Bool


@dataclass
class EdgeView:
    """A line through an edge point, with the receiver that sees it; detached, one entry per kept sample."""

    lane: mi.UInt32
    sight: Sight  # of x_B from x_D
    receiver: Hit  # x_D as the end of a ray from x_B
    value: mi.Spectrum  # |τ×ω|
    pdf: mi.Float  # of the line, times the number of samples
    wavelengths: mi.Color0f
    drawn: Drawn


def sample_lines(job: Job, edges: SecondaryEdges) -> EdgeLine:
    """Lines through edge points, in directions in which the edges can matter."""
    count = edge_samples(job, paths=2)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.INDIRECT_EDGE), lane)
    jitter = rng.next_1d()
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    x, u, drawn = guided(job, count, jitter, rng.next_2d())
    row, t, pdf_row = edges.rows_at(x, count)
    views = edges.views(row)
    through = edges.table.ask(row, lambda kind, own_row, active: kind.line(own_row, t, u, views, active))
    n_perp, across = through.on.across(through.ω)
    valid = through.on.valid & (across > 0) & (through.pdf_sa > 0)
    return EdgeLine(lane, row, t, through, n_perp, across, pdf_row * drawn.p, wavelengths, weight, drawn, valid)


def trace_receivers(job: Job, line: EdgeLine) -> EdgeView | None:
    """The lines that end on a receiver; None if there are none."""
    through, n_perp = line.through, line.n_perp
    on, ω, pdf_sa = through.on, through.ω, through.pdf_sa
    start = on.x + on.aside * n_perp
    met = first_receiver(job, on, start, -ω, line.wavelengths, line.valid)
    if job.scene.environment() is not None and job.form == "spatial":
        # Lines of which one end escapes have their receiver at the other, whichever direction was drawn.
        other = first_receiver(job, on, start, ω, line.wavelengths, line.valid)
        open_end = ~(met.pi.is_valid() & other.pi.is_valid())
        turn = ~met.pi.is_valid()
        ω = dr.select(turn, -ω, ω)
        n_perp = dr.select(turn & (on.aside == 0), -n_perp, n_perp)  # a contour's leads off its surface either way
        met = dr.select(turn, other, met)
        pdf_sa = dr.select(open_end, pdf_sa + through.pdf_reversed, pdf_sa)
    valid = line.valid & met.pi.is_valid()
    if job.facts.has_delta_lobes:  # smooth lobes receive nothing there
        valid &= ~lies_within(on.x, met)
    receiver, above, found = lifted_receiver(job, met, on.x, valid)
    valid &= found
    r = dr.maximum(met.pi.t + dr.dot(start - met.ray.o, ω) - above, on.offset)
    sight = Sight.of(on, line.row, line.t, ω, r, n_perp)
    sight.lead = dr.minimum(on.lead, r)  # rays beside the edge start no farther off than x_D
    view = EdgeView(
        lane=line.lane,
        sight=sight,
        receiver=receiver,
        value=line.weight * line.across,
        pdf=line.pdf_row * pdf_sa,
        wavelengths=line.wavelengths,
        drawn=line.drawn,
    )
    return compact(view, valid)


def first_receiver(job: Job, on: OnEdge, start: mi.Point3f, d: mi.Vector3f, wavelengths, active: mi.Bool) -> Landing:
    """What a line through an edge meets in the direction `d`.

    From near the edge, so that a surface close by is met; but for lines that meet a face of the edge itself there.
    """
    ray = mi.Ray3f(start + dr.minimum(NEAR * on.offset, on.lead) * d, d, 0, wavelengths)
    met = Landing.of(job, ray, active)
    own = active & met.pi.is_valid() & (met.pi.t < on.lead) & lies_within(on.x, met)
    farther = mi.Ray3f(start + on.lead * d, d, 0, wavelengths)
    return dr.select(own, Landing.of(job, farther, own), met)


def lies_within(x: mi.Point3f, met: Landing) -> mi.Bool:
    """Does a line past an edge point x lie within the plane of what it meets, as far as rounding tells?

    It then meets a face of the edge itself, or one in line with it, where it should pass along. A mirror there would
    receive it with a weight of 1/(n·ω).
    """
    return dr.abs(dr.dot(met.n, x - met.p)) <= ROUNDING * dr.max(dr.abs(x))


def slots(records: SubpathRecords, kept: mi.UInt32) -> mi.UInt32:
    """By lane: its number among those `kept`."""
    slot = dr.zeros(mi.UInt32, records.lanes)
    dr.scatter(slot, dr.arange(mi.UInt32, dr.width(kept)), kept)
    return slot


def radiance_by_depth(
    job: Job, ray: mi.Ray3f, pi, lane: mi.UInt32, limits: PathLimits, active: mi.Bool, emission: mi.Bool
):
    """Radiance along `ray`, by depth: `(by_depth, of the whole path)`.

    `lane`: picks the random numbers. `emission`: lanes that count what the first vertex emits.
    """
    rng = lane_sampler(stream_seed(job.seed, Stream.INDIRECT_RADIANCE), lane)
    by_depth = RadianceByDepth(dr.width(lane), limits.max_depth)
    final, _, _ = walk(job.scene, rng, ray, pi, limits, by_depth, emission, active)
    dr.eval(final, by_depth.values, by_depth.reached)
    return by_depth, final


@dataclass
class _Past:
    """What is seen past an edge; detached, one entry per kept line."""

    lane: mi.UInt32
    source: Hit
    wavelengths: mi.Color0f


def arriving(job: Job, view: EdgeView, source: Hit, records: SubpathRecords) -> mi.Spectrum:
    """Radiance from the `source` past each edge, for every recorded vertex (flat, see `SubpathRecords`).

    Within the depth that its subpath leaves, and without what the source itself emits.
    """
    lane, left = records.lane_of(), longest_path(job) - records.vertex_of()
    useful = records.connected()
    kept = dr.compress(useful)
    if dr.width(kept) == 0:
        return dr.zeros(mi.Spectrum, dr.width(lane))
    slot = slots(records, kept)
    past = dr.gather(_Past, _Past(view.lane, source, view.wavelengths), kept)
    dr.eval(past)  # in one kernel, see `compact`
    ray = mi.Ray3f(past.source.o, past.source.d, 0, past.wavelengths)
    pi, limits = past.source.intersection(), replace(job.limits_beside, max_depth=longest_path(job) + 1)
    by_depth, final = radiance_by_depth(job, ray, pi, past.lane, limits, mi.Bool(True), mi.Bool(False))
    needed = dr.gather(mi.Bool, useful, lane)
    slot = dr.gather(mi.UInt32, slot, lane)
    return dr.select(needed, by_depth.up_to(left, slot, dr.gather(mi.Spectrum, final, slot, needed)), 0)


def longest_path(job: Job) -> int:
    """Vertices on both sides of an edge together, at most: the edge's side and an emitter take a segment each."""
    return job.options.max_depth - 2 if job.options.max_depth != -1 else UNLIMITED_VERTICES


def longest_subpath(job: Job) -> int:
    """Vertices from the sensor to the receiver that are recorded, at most."""
    # delta lobes see what the other side of the edge emits, and so do all of lights that are followed
    beyond = 1 if job.facts.has_delta_lobes or followed_lights(job) is not None else 0
    return recorded_vertices(job, longest_path(job) + beyond)
