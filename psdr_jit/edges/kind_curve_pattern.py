"""Steps inside the surfaces of curves: `kind_pattern` on B-spline and linear curves.

Texture coordinates turn with Mitsuba's frame about the axis (`core.curve_frame`), and lines move as the points do that
keep theirs. Both sides of a line are known and not shot at, and the line is seen from outside only.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.curve_frame import frame_turn, radial
from ..core.rod import Rod
from ..core.sensor_frame import SensorFrame, towards_viewer, viewpoint
from ..scene.surfaces import Rods, Splines
from .curve_pattern_rows import Part
from .film_cover import LENS_CENTRE
from .kind import OnEdge, Side, Sight
from .kind_pattern import FAR_SIDE, PatternLines
from .kind_rod import ASIDE, SUNK, TURN
from .pattern_rows import PatternRows
from .points import clearance
from .surface_points import SurfacePoint

#: How much farther beside a line its sides are looked at than on other shapes: u is rounded as the points are of which
#: it is the direction, and curves are thin.
FARTHER = 5.0

#: Share of the way to the pole of a sphere that is left out: u has no direction there.
POLE = 1e-3


@dataclass
class CurvePoint(SurfacePoint):
    """A point of a curve; attached if its control points are."""

    r: mi.Float  # radius there [m]

    @property
    def n(self) -> mi.Vector3f:
        """Outward unit normal."""
        return dr.normalize(dr.cross(self.dx_dq0, self.dx_dq1))


@dataclass(frozen=True)
class CurvePatterns(PatternLines):
    """`PatternRows.v0` is the segment, `part` a `Part` of it, and q is u and the place on that part."""

    @abstractmethod
    def _surface(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> CurvePoint:
        """The point with the coordinates `q` on the segments of `rows`."""

    def _point(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> CurvePoint:
        with dr.suspend_grad():
            return self._surface(rows, q, active)

    def _attached(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> mi.Point3f:
        return self._surface(rows, q, active).x

    def _outside(self, rows: PatternRows, point: CurvePoint, active: mi.Bool) -> mi.Bool:
        """Whether other segments leave it to be seen."""
        return active

    def _unseen(self, frame: SensorFrame, corners: list[mi.Point3f], border: int) -> mi.Bool:
        """What turns away at all corners."""
        rows, eye = self.lines.rows, viewpoint(frame, mi.Point2f(LENS_CENTRE))
        slack = frame.aperture if frame.kind == "thinlens" else 0.0
        away = mi.Bool(True)
        for q in (rows.q0, rows.q1, rows.q2):
            point = self._point(rows, q, mi.Bool(True))
            view = towards_viewer(eye, point.x)
            away &= dr.dot(point.n, view) < -FAR_SIDE * dr.norm(view) - slack
        return away

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, piece = self._located(row, t, active)
        point = self._point(rows, piece.q, active)
        offset, lead = clearance(point.x, point.r, self.centre)
        offset = dr.maximum(offset, ASIDE * point.r)
        return OnEdge(
            x=point.x,
            dx=mi.Float(rows.count) * point.towards(piece.along),
            outward=point.n,
            local=mi.Point3f(point.n),
            scale=point.r,
            offset=offset,
            lead=dr.maximum(lead, offset),
            aside=offset,
            valid=active & self._outside(rows, point, active),
        )

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Above the surface, by more than how exactly Mitsuba meets curves."""
        return sight.at.x + sight.offset * mi.Vector3f(sight.at.local)

    def _faces(self, sight: Sight) -> mi.Bool:
        """Is it seen from outside?"""
        return dr.dot(mi.Vector3f(sight.at.local), sight.ω) < 0

    def _next_to(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool):
        """`(rows, q of the line, q on side which)`."""
        rows, beside = self._beside(row, sight, which, active)
        q = self._located(row, sight.at.t, active)[1].q
        return rows, q, q + FARTHER * (beside - q)


@dataclass(frozen=True)
class TubePatterns(CurvePatterns):
    """On B-spline curves."""

    segments: Splines

    def _surface(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> CurvePoint:
        axis = self.segments.axis(rows.v0, q.y, active)
        speed = dr.norm(axis.dc)
        t = axis.dc / speed
        a, da = radial(t, q.x)
        along = axis.bend(axis.r * a) / dr.square(speed)
        dx_dv = along * axis.dc + axis.dr * a + axis.r * frame_turn(t, axis.ddc / speed) * da
        return CurvePoint(mi.Point3f(axis.c + axis.r * a), axis.r * da, dx_dv, axis.r)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        rows, _, q = self._next_to(row, sight, which, active)
        side = Side.of_segment(self.segments, rows.v0, self._point(rows, q, active).x, sight, which, active)
        side.pi.prim_uv = mi.Point2f(q.y, 0)
        side.differs = self._faces(sight)
        return side


@dataclass(frozen=True)
class RodPatterns(CurvePatterns):
    """On linear curves: on their sides, the spheres at their ends and joints, and between these."""

    segments: Rods

    def _surface(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> CurvePoint:
        rod = self.segments.rod(rows.v0, active)
        axis, s = rod.axis
        first, last = rows.part == int(Part.FIRST_CAP), rows.part == int(Part.LAST_CAP)
        on_cap = first | last
        rim = dr.safe_asin(-s)
        room = (1 - POLE) * dr.select(first, rim + 0.5 * dr.pi, 0.5 * dr.pi - rim)
        sin, cos = dr.sincos(rim + dr.select(on_cap, room * (q.y - dr.select(first, 1.0, 0.0)), 0))
        v = dr.select(on_cap, dr.select(first, 0.0, 1.0), q.y)
        a, da = radial(axis, q.x)
        n, r = sin * axis + cos * a, rod.radius(v)
        along = dr.select(on_cap, r * room * (cos * axis - sin * a), rod.dc + rod.dr * n)
        return CurvePoint(mi.Point3f(rod.centre(v) + r * n), r * cos * da, along, r)

    def _outside(self, rows: PatternRows, point: CurvePoint, active: mi.Bool) -> mi.Bool:
        own = self.segments.rod(rows.v0, active)
        first, last = rows.part == int(Part.FIRST_CAP), rows.part == int(Part.LAST_CAP)
        free = active & (own.has_side | (first & (own.dr < 0)) | (last & (own.dr > 0)))
        for step in (-1, 1):
            other, there = self._neighbour(rows.v0, step, active)
            free &= ~there | (other.height(point.x) > -SUNK * point.r)
        return free

    def _neighbour(self, segment: mi.UInt32, step: int, active: mi.Bool) -> tuple[Rod, mi.Bool]:
        """The segment before (−1) or after (1) on the same curve, and whether there is one."""
        count = dr.width(self.segments.first)
        inner = active & (segment > 0 if step < 0 else segment + 1 < count)
        other = dr.select(inner, segment + (0xFFFFFFFF if step < 0 else 1), segment)
        starts = (dr.gather(mi.UInt32, self.segments.first, k, active) for k in (segment, other))
        owners = (dr.gather(mi.UInt32, self.segments.owner, k, active) for k in (segment, other))
        (a, b), (owner_a, owner_b) = starts, owners
        joined = (b + 1 == a) if step < 0 else (a + 1 == b)
        return self.segments.rod(other, active), inner & joined & (owner_a == owner_b)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """At a rim, what lies beyond the side is the sphere at its end; at a joint, that of the segment before."""
        rows, at, q = self._next_to(row, sight, which, active)
        first, last = rows.part == int(Part.FIRST_RING), rows.part == int(Part.LAST_RING)
        beyond = (first & (q.y < at.y)) | (last & (q.y > at.y))
        segment = dr.select(beyond & first, rows.v0 + 0xFFFFFFFF, rows.v0)
        axis = self.segments.rod(segment, active).axis[0]
        rod, n = self.segments.rod(rows.v0, active), mi.Vector3f(sight.at.local)
        on_sphere = rod.centre(at.y) + rod.radius(at.y) * dr.normalize(n + TURN * axis)
        x = dr.select(beyond, on_sphere, self._point(rows, q, active).x)
        side = Side.of_segment(self.segments, segment, mi.Point3f(dr.detach(x)), sight, which, active)
        side.differs = self._faces(sight)
        return side
