"""How much of an edge a sensor can see: what the primary boundary's rows are drawn in proportion to.

The prior length × exterior angle is the one a viewpoint-free table would use; for a given sensor the projected length
is known, and edges that provably cannot contribute get weight 0: outside the film, on the far side of a closed shape,
or between faces that look alike. Uses only what forward and backward mode both know.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, look_at, towards_viewer, viewpoint
from .points import facing
from .rows import EdgeRows

#: Edges this far outside the film [px] may still matter: a lens point other than the centre sees them elsewhere.
LENS_CENTRE = 0.5

#: Least length that counts [px]: an edge seen end-on is still an edge.
LEAST_LENGTH = 1e-3


def lens_reach(frame: SensorFrame, depth: mi.Float) -> mi.Float:
    """Largest displacement on the film [px] when the lens point moves from the centre to the rim, at a depth."""
    if frame.kind != "thinlens":
        return mi.Float(0)
    px_per_unit = dr.rsqrt(mi.Float(frame.px_area)) / frame.focus
    return frame.aperture * dr.abs(1 - frame.focus / depth) * px_per_unit


def overlaps_film(frame: SensorFrame, a: mi.Point2f, b: mi.Point2f, margin: mi.Float, border: int) -> mi.Bool:
    """Does the bounding box of two film positions [px] overlap the sampled window?"""
    inside = mi.Bool(True)
    for axis in range(2):
        lower = frame.crop_offset[axis] - border
        upper = frame.crop_offset[axis] + frame.crop_size[axis] + border
        inside &= (dr.maximum(a[axis], b[axis]) >= lower - margin) & (dr.minimum(a[axis], b[axis]) <= upper + margin)
    return inside


def beside_film(frame: SensorFrame, corners: list[mi.Point3f], border: int) -> mi.Bool:
    """Are flat patches beside the view of a pinhole, though some of their corners may lie behind it?

    On each side of the film the view ends in a plane through the pinhole: all corners are beyond the same one. False
    for other sensors.
    """
    if frame.kind != "perspective":
        return mi.Bool(False)
    local = [frame.to_local @ x for x in corners]
    beside = mi.Bool(False)
    for axis in range(2):
        film = [(q[axis] - frame.corner[axis] * q.z) / frame.extent[axis] for q in local]  # times the depth
        margin = border / frame.crop_size[axis]
        for beyond in ([f < -margin * q.z for f, q in zip(film, local, strict=True)],
                       [f > (1 + margin) * q.z for f, q in zip(film, local, strict=True)]):  # fmt: skip
            beside |= beyond[0] & beyond[1] & beyond[2]
    return beside


@dataclass
class PatchOnFilm:
    """Where three corners are seen from the centre of the lens, by row."""

    lower: mi.Point2f  # of their box on the film [px]
    upper: mi.Point2f
    nearest: mi.Float  # their depths [m]
    farthest: mi.Float
    reach: mi.Float  # how far other points of the lens see them elsewhere, at most [px]

    @staticmethod
    def of(corners: list[mi.Point3f], frame: SensorFrame) -> PatchOnFilm:
        seen = [look_at(frame, x, mi.Point2f(LENS_CENTRE)).p for x in corners]
        depth = [(frame.to_local @ x).z for x in corners]
        lower, nearest = (dr.minimum(dr.minimum(v[0], v[1]), v[2]) for v in (seen, depth))
        upper, farthest = (dr.maximum(dr.maximum(v[0], v[1]), v[2]) for v in (seen, depth))
        reach = dr.maximum(lens_reach(frame, nearest), lens_reach(frame, farthest))
        return PatchOnFilm(mi.Point2f(lower), mi.Point2f(upper), nearest, farthest, reach)

    def cover(self, frame: SensorFrame, border: int, length: mi.Float, margin: mi.Float) -> mi.Float:
        """`length` [px] of what lies on the patch, 0 where it is off the film by more than `margin` [px] or behind the
        sensor; the film's diagonal where part of it is too near to be seen as a whole.
        """
        film = dr.norm(mi.Vector2f(frame.crop_size))
        whole = (self.nearest > frame.near) & (self.nearest < frame.far)
        overlaps = overlaps_film(frame, self.lower, self.upper, margin, border)
        found = dr.select(whole, dr.select(overlaps, dr.clip(length, LEAST_LENGTH, film), 0), film)
        return dr.select(self.farthest <= frame.near, 0, found)


@dataclass
class EdgeOnFilm:
    """Which way the faces of an edge turn, by row; conservative for every point of a lens."""

    may_be_outline: mi.Bool
    behind0: mi.Bool  # hidden by the closed surface that face 0 belongs to
    behind1: mi.Bool

    @staticmethod
    def of(rows: EdgeRows, frame: SensorFrame) -> EdgeOnFilm:
        view = towards_viewer(viewpoint(frame, mi.Point2f(LENS_CENTRE)), rows.p0)
        s0, s1 = facing(rows.n0, view), facing(rows.n1, view)
        slack = frame.aperture if frame.kind == "thinlens" else 0.0  # how far the viewpoint may be from the centre
        outline = (s0 * s1 <= 0) | (dr.minimum(dr.abs(s0), dr.abs(s1)) <= slack)
        hidden = ((shell != 0) & (s * shell <= -slack) for s, shell in ((s0, rows.shell0), (s1, rows.shell1)))
        return EdgeOnFilm(outline, *hidden)


def straight_cover(
    rows: EdgeRows, frame: SensorFrame, border: int, relevance: mi.Float, hidden: mi.Bool
) -> mi.Float:
    """Relative sampling weight of straight edges [px]: their projected length, times `relevance`; detached."""
    centre = mi.Point2f(LENS_CENTRE)
    a, b = look_at(frame, rows.p0, centre), look_at(frame, rows.p1, centre)
    z0, z1 = (frame.to_local @ rows.p0).z, (frame.to_local @ rows.p1).z
    in_front = (dr.minimum(z0, z1) > frame.near) & (dr.minimum(z0, z1) < frame.far)
    behind = dr.maximum(z0, z1) <= frame.near
    reach = dr.maximum(lens_reach(frame, z0), lens_reach(frame, z1))
    film = dr.norm(mi.Vector2f(frame.crop_size))
    length = dr.clip(dr.norm(b.p - a.p), LEAST_LENGTH, film)
    length = dr.select(in_front, dr.select(overlaps_film(frame, a.p, b.p, reach, border), length, 0), film)
    return dr.select(hidden | behind, 0, relevance * length)


def curve_cover(
    frame: SensorFrame, border: int, corners: list[mi.Point3f], ends: tuple[mi.Point3f, mi.Point3f], known: mi.Bool
) -> mi.Float:
    """Relative sampling weight of a curve inside a face [px]: how far its `ends` are apart on the film where they are
    `known`, else the longest side of the face; detached.
    """
    patch = PatchOnFilm.of(corners, frame)
    a, b = (look_at(frame, end, mi.Point2f(LENS_CENTRE)).p for end in ends)
    length = dr.select(known, dr.norm(b - a), dr.norm(patch.upper - patch.lower))
    return patch.cover(frame, border, length, patch.reach)


def outline_cover(frame: SensorFrame, border: int, x: list[mi.Point3f]) -> mi.Float:
    """Relative sampling weight of a piece of a contour [px], of which the points `x` are the start, the middle and the
    end as seen from the centre of the lens; detached.
    """
    lens = mi.Point2f(LENS_CENTRE)
    a, middle, b = (look_at(frame, point, lens) for point in x)
    valid = a.valid | middle.valid | b.valid
    # A piece is an arc, not its chord: leave room for the sagitta.
    chord = dr.norm(b.p - middle.p) + dr.norm(middle.p - a.p)
    margin = chord + 1 + lens_reach(frame, (frame.to_local @ x[1]).z)
    film = dr.norm(mi.Vector2f(frame.crop_size))
    length = dr.clip(chord, LEAST_LENGTH, film)
    whole = a.valid & middle.valid & b.valid
    overlaps = overlaps_film(frame, a.p, b.p, margin, border)
    return dr.select(valid, dr.select(~whole | overlaps, length, 0), 0)
