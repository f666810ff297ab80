"""Beside an edge a sphere is seen with which directions turn: that side of the boundary moves, seen from x_D.

The indirect term compares directions that rest (`indirect.py`). On a side where a mirror or a ball of glass lies, the
directions from a smooth x_D turn by η (`paths/orbits.py`), so that the edge moves by s·r_B η less against them:

    ∓ L · W · |τ×ω| · r_B s·η(ċ − u_D, Ṙ/R) / pdf        (− where the sphere lies on the side −s of the edge)

η is linear in what moves: r_B s·η = q·(ċ − u_D) + s Ṙ/R. Lines and random numbers are those of the indirect term, so
that both add up as one estimate would: at the outline of the sphere itself its side then brings nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.records import Hit
from ..core.streams import Stream
from ..edges.table import look_beside
from ..plan.job import Job
from ..sampling.relevance import SecondaryEdges
from .edge_lines import EdgeView, arriving, longest_subpath
from .segment_motion import BoundarySamples
from .sensor_subpath import Receivers, subpaths


@dataclass
class OrbitSide:
    """A side of an edge on which such a sphere is seen; detached, one entry per kept side."""

    view: EdgeView
    source: Hit  # a ray past the edge, which ends on the sphere
    sign: mi.Float  # −1 on side −s, +1 on side +s
    q: mi.Vector3f  # covector on the centre, and −q on u_D
    s: mi.Float  # on the relative change of the radius


def trace(job: Job, edges: SecondaryEdges, view: EdgeView | None) -> OrbitSide | None:
    """The sides of `view` on which a sphere turns directions."""
    if view is None:
        return None
    index = dr.arange(mi.UInt32, 2 * dr.width(view.lane))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    ray, pi, differs = look_beside(job.scene, edges.table, v.sight, which, v.wavelengths)
    end = v.receiver
    x_D = mi.Point3f(end.o + end.t * end.d)
    source = Hit.of(ray, pi)
    sphere = job.orbits.seen(x_D, end.shape, v.sight.ω, source.shape, differs & pi.is_valid())
    q, s = sphere.covectors(v.sight.r * v.sight.n_perp)
    sign = dr.select(which == 0, -1.0, 1.0)
    found = OrbitSide(v, source, sign, q, s)
    return compact(found, sphere.holds)


def evaluate(job: Job, edges: SecondaryEdges, o: OrbitSide) -> BoundarySamples:
    """What the turn is worth at the sensor."""
    v = o.view
    value = v.value * (o.sign / v.pdf)
    receivers = Receivers(v.lane, v.receiver, v.wavelengths, value, -o.q, mi.Vector3f(0))
    records = subpaths(job, Stream.INDIRECT_SUBPATH, receivers, longest_subpath(job))
    value = job.call.counters.rejected.keep_finite(records.data.W * arriving(job, v, o.source, records))
    dr.eval(value)

    def source_motion(moving) -> mi.Float:
        centre, radius = job.orbits.motion(moving, o.source.shape)
        return dr.dot(o.q, centre) + o.s * radius

    return BoundarySamples(v.sight.at, v.sight.ω, mi.Vector3f(0), v.wavelengths, records, value, source_motion, v.drawn)
