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

from ..core.compaction import compact
from ..core.records import Hit
from ..core.streams import Stream
from ..edges.table import look_behind
from ..plan.job import Job
from ..sampling.relevance import SecondaryEdges
from .edge_lines import EdgeLine, EdgeView, arriving, longest_subpath, trace_receivers
from .segment_motion import BoundarySamples
from .sensor_subpath import Receivers, subpaths


@dataclass
class Background:
    """One side of an edge that somebody sees, and what lies behind; detached, one entry per kept side."""

    view: EdgeView
    source: Hit  # x_S as the end of a ray past the edge
    ratio: mi.Float  # ρ
    sign: mi.Float  # +1 on side −s, −1 on side +s


def trace(job: Job, edges: SecondaryEdges, line: EdgeLine) -> Background | None:
    """Both sides of every edge point with a receiver, as far as a surface lies there that moves against the edge."""
    view = trace_receivers(job, line)
    if view is None:
        return None
    index = dr.arange(mi.UInt32, 2 * dr.width(view.lane))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    ray, pi, beyond = look_behind(job.scene, edges.table, v.sight, which, v.wavelengths)
    r = v.sight.r
    found = Background(v, Hit.of(ray, pi), r / (r + beyond), dr.select(which == 0, 1.0, -1.0))
    return compact(found, pi.is_valid())


def evaluate(job: Job, edges: SecondaryEdges, b: Background) -> BoundarySamples:
    """What the background is worth at the sensor."""
    v = b.view
    # An edge that moves as the line turns does so as x_D and x_S move against each other: ω̇ = (v_S − u_D)/r_S.
    turn = edges.table.turn(v.sight.at, v.sight.ω, v.sight.n_perp) * (b.ratio / v.sight.r)
    a = -(1 - b.ratio) * v.sight.n_perp - turn
    receivers = Receivers(v.lane, v.receiver, v.wavelengths, v.value * (b.sign / v.pdf), a, mi.Vector3f(0))
    records = subpaths(job, Stream.INDIRECT_SUBPATH, receivers, longest_subpath(job))
    value = job.call.counters.rejected.keep_finite(records.data.W * arriving(job, v, b.source, records))
    dr.eval(value)
    return BoundarySamples(
        at=v.sight.at,
        ω=v.sight.ω,
        n_perp=v.sight.n_perp,
        wavelengths=v.wavelengths,
        records=records,
        value=value,
        source_motion=lambda moving: dr.dot(turn - b.ratio * v.sight.n_perp, moving.of_surface(b.source)),
        drawn=v.drawn,
    )
