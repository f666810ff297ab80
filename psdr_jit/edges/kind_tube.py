"""Outlines of B-spline curves: two along the tube, and the rims of its open ends (`core.tube_axis`).

Mitsuba does not show the inside of a tube: of a rim only that part is an edge from which the outside is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.tube_axis import Axis
from ..core.upload import uploaded
from ..scene.surfaces import Splines
from .kind import ContourKind, OnEdge, Side, Sight, Use
from .location import EdgeLocation
from .points import INSET, clearance

#: Rows of a segment on each side, and of a rim: hidden or distant parts get their own weight.
PIECES, RIM_PIECES = 4, 16

#: Step along a segment for the derivative of an outline.
DIFFERENCE = 1e-3

#: Steps off an outline in units of the radius: Mitsuba meets curves to about a thousandth of that.
ASIDE = 4e-3

#: Angle about the axis by which the tube's own surface is looked at inside of its outline [rad].
TURN = 1e-3


@dataclass
class TubeRows:
    """One entry per piece; detached device arrays."""

    segment: mi.UInt32
    start: mi.Float  # v of an outline, or turns about the axis of a rim, at which it begins ...
    length: mi.Float  # ... and how far it goes
    side: mi.Float  # of an outline ±1; 0: a rim
    end: mi.Float  # of a rim: −1 at v = 0, 1 at v = 1
    moves: mi.Bool


def tube_rows(tubes: Splines) -> TubeRows:
    """Pieces of all B-spline curves."""
    moves = np.array(tubes.moves)[np.array(tubes.owner)]
    segment = np.arange(len(moves))
    starts, ends = (np.array(a) for a in tubes.ends(dr.arange(mi.UInt32, len(moves)), mi.Bool(True)))
    columns = []
    for side in (-1, 1):
        for piece in range(PIECES):
            columns.append(_pieces(segment, piece / PIECES, 1 / PIECES, side, 0))
    for end, here in ((-1, segment[starts]), (1, segment[ends])):
        for piece in range(RIM_PIECES):
            columns.append(_pieces(here, piece / RIM_PIECES, 1 / RIM_PIECES, 0, end))
    of, *floats = (np.concatenate(c) for c in zip(*columns, strict=True))
    return TubeRows(uploaded(mi.UInt32, of), *(uploaded(mi.Float, a) for a in floats), uploaded(mi.Bool, moves[of]))


def _pieces(segment: np.ndarray, *values: float) -> tuple[np.ndarray, ...]:
    return segment, *(np.full(len(segment), value, float) for value in values)


@dataclass(frozen=True)
class TubeOutlines(ContourKind):
    """Pieces of the outlines of curves."""

    tubes: Splines
    rows: TubeRows
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.rows.segment)

    def moving(self) -> mi.Bool:
        return self.rows.moves

    def _axis(self, rows: TubeRows, t: mi.Float, active: mi.Bool) -> tuple[Axis, mi.Float]:
        """The axis at t of the rows, and v there. Detached where gradients are suspended."""
        v = dr.select(rows.side != 0, rows.start + t * rows.length, dr.select(rows.end > 0, 1.0, 0.0))
        return self.tubes.axis(rows.segment, v, active), v

    def places(self) -> mi.Point3f:
        return mi.Point3f(dr.detach(self._axis(self.rows, mi.Float(0.5), mi.Bool(True))[0].c))

    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        rows = dr.gather(TubeRows, self.rows, row, active)
        return mi.Point3f(dr.detach(self._axis(rows, mi.Float(0.5), active)[0].c))

    def line_weights(self, use: Use) -> mi.Float:
        a, b = (self._axis(self.rows, mi.Float(t), mi.Bool(True))[0] for t in (0.0, 1.0))
        rim = dr.two_pi * a.r * self.rows.length
        return dr.detach(dr.select(self.rows.side != 0, dr.norm(b.c - a.c), rim) * dr.pi)

    def _outline(self, rows: TubeRows, t: mi.Float, view: mi.Vector4f, active: mi.Bool):
        """`(axis, ρ, valid)` of a point of an outline."""
        axis, _ = self._axis(rows, t, active)
        return axis, *axis.tangent_point(view, rows.side)

    def _on_outline(self, rows: TubeRows, t: mi.Float, view: mi.Vector4f, active: mi.Bool):
        """`(axis, ρ, dx/dt, outward, valid)`."""
        axis, ρ, valid = self._outline(rows, t, view, active)
        h = DIFFERENCE / rows.length
        ahead, behind = (self._outline(rows, t + step, view, active) for step in (h, -h))
        dx = (ahead[0].c + ahead[1] - behind[0].c - behind[1]) / (2 * h)
        return axis, ρ, dx, axis.normal(ρ), valid & ahead[2] & behind[2]

    def _on_rim(self, rows: TubeRows, t: mi.Float, axis: Axis):
        """`(ρ, dx/dt, outward, valid)`."""
        a, b, _ = axis.circle(mi.coordinate_system(dr.normalize(axis.dc))[0])
        sin, cos = dr.sincos(dr.two_pi * (rows.start + t * rows.length))
        ρ = axis.r * (cos * a + sin * b)
        dx = dr.two_pi * rows.length * axis.r * (cos * b - sin * a)
        return ρ, dx, axis.dc * rows.end, axis.r > 0

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows = dr.gather(TubeRows, self.rows, row, active)
        axis, *outline = self._on_outline(rows, t, view, active)
        rim = self._on_rim(rows, t, axis)
        is_rim = rows.side == 0
        ρ, dx, outward, valid = (dr.select(is_rim, a, b) for a, b in zip(rim, outline, strict=True))
        x = mi.Point3f(axis.c + ρ)
        offset, lead = clearance(x, axis.r, self.centre)
        offset = dr.maximum(offset, ASIDE * axis.r)
        return OnEdge(x, dx, outward, mi.Point3f(ρ), axis.r, offset, lead, offset, active & valid)

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """A ray aimed at a tangent point meets the tube itself: beside it."""
        return sight.at.x + sight.offset * sight.n_perp

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The tube itself on the side −n_perp, and whatever a ray meets on the other.

        The tube is never shot at: what it looks like a little inside of the edge is known better than Mitsuba meets it.
        """
        own = which == 0
        rows = dr.gather(TubeRows, self.rows, row, active)
        is_rim = rows.side == 0
        v = dr.select(is_rim, dr.select(rows.end > 0, 1 - INSET, INSET), rows.start + sight.at.t * rows.length)
        axis = self.tubes.axis(rows.segment, v, active)
        a, b, _ = axis.circle(mi.Vector3f(sight.at.local))
        towards = dr.select(dr.dot(axis.turned_normal(a, b), sight.ω) < 0, TURN, -TURN)
        sin, cos = dr.sincos(dr.select(is_rim, 0, towards))
        x = axis.c + axis.r * (cos * a + sin * b)
        side = Side.of_segment(self.tubes, rows.segment, mi.Point3f(x), sight, which, own & active)
        side.pi.prim_uv = mi.Point2f(v, 0)
        side.differs = ~is_rim | (dr.dot(axis.normal(axis.r * a), sight.ω) < 0)
        return side

    def shades(self, row: mi.UInt32, on: OnEdge, ω: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        rows = dr.gather(TubeRows, self.rows, row, active)
        axis, _ = self._axis(rows, mi.Float(0), active)
        return (rows.side != 0) | (dr.dot(axis.normal(mi.Vector3f(on.local)), ω) < 0)

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of a material point, which keeps its place on its circle as the circle moves, swells and tilts."""
        rows = dr.gather(TubeRows, self.rows, row, active)
        axis, _ = self._axis(rows, at.t, active)
        a, _, _ = axis.circle(mi.Vector3f(dr.detach(at.local)))
        x = axis.c + axis.r * a
        return dr.select(active, mi.Vector3f(x - dr.detach(x)), 0)
