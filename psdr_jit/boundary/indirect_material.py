"""Indirect boundary in *material* form: what appears or disappears behind a silhouette, seen from another surface.

Vertices keep their material points, so visible creases, borders and seams are at rest and only silhouettes are left,
one side of them: what lies behind. With x_S that point, ρ = r_B/r_S, and the line's measure as in `edge_lines.py`:

    ± L_S · W · |τ×ω| · s·[ v_B − ρ v_S − (1 − ρ) u_D ] / pdf        (+ where x_S lies on the side −s of the edge)

[Zhang et al. 2020, §5]. Motion relative to the surface it happens on: at an edge's own face ρ = 1 and v_S = v_B, which
is why its side has no term; where two surfaces cut into each other, both sides have one. u_D is the material velocity
of x_D, unless x_D is what the sensor sees: that point slides (`sensor_subpath.py`). What x_S emits is in the direct
term.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.streams import Stream
from ..edges.location import EdgeLocation
from ..edges.table import EdgeTable, background, compact, shared_frame
from ..plan.job import Job
from ..sampling.directions import background_wedges, wedge_measure
from ..sampling.relevance import SecondaryEdges, secondary_edges
from .edge_lines import EdgeView, longest_subpath, radiance_by_depth, sample_views, slots
from .segment_motion import BoundarySamples
from .sensor_subpath import Receivers, SubpathRecords, subpaths

#: Share of a resting edge's directions in which movers are behind it; otherwise they are in front.
AHEAD = 0.5


@dataclass
class Background:
    """One side of an edge that somebody sees, and what lies behind; detached, one entry per kept side."""

    view: EdgeView
    source: Hit  # x_S as the end of a ray past the edge
    ratio: mi.Float  # ρ
    sign: mi.Float  # +1 on side −s, −1 on side +s


def background_edges(job: Job) -> SecondaryEdges | None:
    """The edges behind which something can appear."""
    return secondary_edges(job, lambda rows: wedge_measure(background_wedges(rows)), lights_count=False, ahead=AHEAD)


def _backgrounds(job: Job, table: EdgeTable, view: EdgeView) -> Background:
    """Both sides of every edge point, as far as a surface lies there that does not move with the edge."""
    index = dr.arange(mi.UInt32, 2 * dr.width(view.row))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    ray, pi, beyond = background(job.scene, table, v.row, v.t, v.point(), v.scale, which, v.wavelengths)
    found = Background(v, Hit.of(ray, pi), v.r / (v.r + beyond), dr.select(which == 0, 1.0, -1.0))
    return compact(found, pi.is_valid())


def _radiance(job: Job, b: Background, records: SubpathRecords) -> mi.Spectrum:
    """L_S for every recorded vertex, within the depth that its subpath leaves (flat, see `SubpathRecords`)."""
    lane, left = records.lane_of(), records.depth - records.vertex_of()
    useful = records.connected()
    kept = dr.compress(useful)
    if dr.width(kept) == 0:
        return dr.zeros(mi.Spectrum, dr.width(lane))
    slot = slots(records, kept)
    s = dr.gather(Background, b, kept)
    ray = mi.Ray3f(s.source.o, s.source.d, 0, s.view.wavelengths)
    by_depth, final = radiance_by_depth(
        job, ray, s.source.intersection(), s.view.lane, records.depth + 1, mi.Bool(True)
    )
    needed = dr.gather(mi.Bool, useful, lane)
    slot = dr.gather(mi.UInt32, slot, lane)
    L = by_depth.up_to(left, slot, dr.gather(mi.Spectrum, final, slot, needed))
    return dr.select(needed, L, 0)


def prepared(job: Job) -> BoundarySamples | None:
    """Sampled, traced and recorded; None if there is nothing to sample."""
    frame = shared_frame(job)
    edges = background_edges(job)
    if edges is None:
        return None
    view = sample_views(job, frame, edges, background_wedges)
    if dr.width(view.row) == 0:
        return None
    b = _backgrounds(job, edges.table, view)
    if dr.width(b.sign) == 0:
        return None
    v = b.view
    receivers = Receivers(v.lane, v.receiver, v.wavelengths, v.weight * b.sign, -(1 - b.ratio) * v.side)
    records = subpaths(job, frame, Stream.INDIRECT_SUBPATH, receivers, longest_subpath(job))
    value = job.call.counters.rejected.keep_finite(records.data.W * _radiance(job, b, records))
    dr.eval(value)
    return BoundarySamples(
        table=edges.table,
        at=EdgeLocation(v.row, v.t, v.x, v.local, v.scale),
        n=v.side,
        wavelengths=v.wavelengths,
        records=records,
        value=value,
        source_motion=lambda moving: -b.ratio * dr.dot(b.view.side, moving.of_surface(b.source)),
    )
