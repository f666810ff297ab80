"""Where on which edge to sample the primary boundary: in proportion to what an edge covers on the film.

The prior length × exterior angle is the one a viewpoint-free table would use; for a given sensor the projected
length is known, and edges that provably cannot contribute get weight 0: outside the film, on the far side of a closed
shape, or between faces that look alike. Uses only what forward and backward mode both know.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, look_at, viewpoint
from ..edges.curves import CurveSet
from ..edges.points import curve_row_point, facing
from ..edges.segments import EdgeSet
from .directions import crease_relevance

#: Edges this far outside the film [px] may still matter: a lens point other than the centre sees them elsewhere.
LENS_CENTRE = 0.5


def _lens_reach(frame: SensorFrame, depth: mi.Float) -> mi.Float:
    """Largest displacement on the film [px] when the lens point moves from the centre to the rim, at a depth."""
    if frame.kind != "thinlens":
        return mi.Float(0)
    px_per_unit = dr.rsqrt(mi.Float(frame.px_area)) / frame.focus
    return frame.aperture * dr.abs(1 - frame.focus / depth) * px_per_unit


def _overlaps(frame: SensorFrame, a: mi.Point2f, b: mi.Point2f, margin: mi.Float, border: int) -> mi.Bool:
    """Does the bounding box of two film positions [px] overlap the sampled window?"""
    inside = mi.Bool(True)
    for axis in range(2):
        lower = frame.crop_offset[axis] - border
        upper = frame.crop_offset[axis] + frame.crop_size[axis] + border
        inside &= (dr.maximum(a[axis], b[axis]) >= lower - margin) & (dr.minimum(a[axis], b[axis]) <= upper + margin)
    return inside


def segment_weights(edges: EdgeSet, frame: SensorFrame, border: int) -> mi.Float:
    """Relative sampling weight of every straight edge [px]; detached."""
    rows = edges.rows
    centre = mi.Point2f(LENS_CENTRE)
    view = viewpoint(frame, centre)
    a, b = look_at(frame, rows.p0, centre), look_at(frame, rows.p1, centre)
    z0, z1 = (frame.to_local @ rows.p0).z, (frame.to_local @ rows.p1).z

    s0, s1 = facing(rows.n0, rows.p0, view), facing(rows.n1, rows.p0, view)
    slack = frame.aperture if frame.kind == "thinlens" else 0.0  # how far the viewpoint may be from the centre
    may_be_silhouette = rows.traced | rows.border | (s0 * s1 <= 0) | (dr.minimum(dr.abs(s0), dr.abs(s1)) <= slack)
    relevance = dr.select(may_be_silhouette, 1, crease_relevance(rows))
    behind0, behind1 = ((shell != 0) & (s * shell < -slack) for s, shell in ((s0, rows.shell0), (s1, rows.shell1)))
    # Where two surfaces cut into each other, being behind one of them is enough.
    hidden = dr.select(rows.junction > 0, behind0 | behind1, behind0 & behind1)

    in_front = (dr.minimum(z0, z1) > frame.near) & (dr.minimum(z0, z1) < frame.far)
    behind = dr.maximum(z0, z1) <= frame.near
    reach = dr.maximum(_lens_reach(frame, z0), _lens_reach(frame, z1))
    film = dr.norm(mi.Vector2f(frame.crop_size))
    length = dr.clip(dr.norm(b.p - a.p), 1e-3, film)
    length = dr.select(in_front, dr.select(_overlaps(frame, a.p, b.p, reach, border), length, 0), film)
    return dr.select(hidden | behind, 0, relevance * length)


def curve_weights(curves: CurveSet, frame: SensorFrame, border: int) -> mi.Float:
    """Relative sampling weight of every piece of an analytic curve [px]; detached."""
    row = dr.arange(mi.UInt32, dr.width(curves.rows.kind))
    ends = [
        curve_row_point(curves, row, mi.Float(t), frame, mi.Point2f(LENS_CENTRE), mi.Bool(True))
        for t in (0.0, 0.5, 1.0)
    ]
    (a, _, _), (middle, _, _), (b, _, _) = ends
    valid = a.view.valid | middle.view.valid | b.view.valid
    # A piece is an arc, not its chord: leave room for the sagitta.
    chord = dr.norm(b.view.p - middle.view.p) + dr.norm(middle.view.p - a.view.p)
    margin = chord + 1 + _lens_reach(frame, (frame.to_local @ middle.x).z)
    film = dr.norm(mi.Vector2f(frame.crop_size))
    length = dr.clip(chord, 1e-3, film)
    whole = a.view.valid & middle.view.valid & b.view.valid
    overlaps = _overlaps(frame, a.view.p, b.view.p, margin, border)
    return dr.select(valid, dr.select(~whole | overlaps, length, 0), 0)
