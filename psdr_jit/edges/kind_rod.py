"""Edges of linear curves (`core.rod`): outlines of their sides, ends and joints, and the creases of their joints.

An outline ends where it runs into the neighbour of its segment. Creases are dents: both surfaces are seen there, and
no light ends at them. Where other parts of a curve touch each other is not looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.rod import Rod
from ..core.rod_crease import crease
from ..scene.surfaces import NONE, Rods
from .kind import ContourKind, OnEdge, Side, Sight, Use
from .location import EdgeLocation
from .points import clearance
from .rod_rows import CREASE, END, SIDE, RodRows

#: Steps off an edge in units of the radius, clear of how exactly Mitsuba meets curves.
ASIDE = 4e-3

#: Angle by which the curve's own surface is looked at inside of its outline [rad].
TURN = 1e-3

#: Depth in units of the radius from which a point lies inside of a neighbour: rounding is less.
SUNK = 2e-5

#: Sine of the angle between two surfaces below which their crease has no velocity of its own.
SHALLOW = 1e-3


@dataclass(frozen=True)
class RodEdges(ContourKind):
    """Pieces of the edges of linear curves."""

    rods: Rods
    rows: RodRows
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.rows.segment)

    def moving(self) -> mi.Bool:
        return self.rows.moves

    def _neighbour(self, segment: mi.UInt32, active: mi.Bool) -> tuple[Rod, mi.Bool]:
        """A neighbour, and whether there is one."""
        there = active & (segment != NONE)
        return self.rods.rod(dr.select(there, segment, 0), mi.Bool(True)), there

    def places(self) -> mi.Point3f:
        rod = self.rods.rod(self.rows.segment, mi.Bool(True))
        v = dr.select(self.rows.part == SIDE, 0.5, dr.select(self.rows.side > 0, 1.0, 0.0))
        return mi.Point3f(dr.detach(rod.centre(v)))

    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        rows = dr.gather(RodRows, self.rows, row, active)
        rod = self.rods.rod(rows.segment, active)
        return mi.Point3f(dr.detach(rod.centre(dr.select(rows.part == SIDE, 0.5, dr.select(rows.side > 0, 1.0, 0.0)))))

    def line_weights(self, use: Use) -> mi.Float:
        """Of a crease, its steps alone."""
        rod = self.rods.rod(self.rows.segment, mi.Bool(True))
        around = dr.two_pi * rod.radius(dr.select(self.rows.side > 0, 1.0, 0.0))
        length = dr.select(self.rows.part == SIDE, dr.norm(rod.dc), around) * self.rows.length
        counts = (self.rows.part != CREASE) | (use is Use.STEP)
        return dr.detach(dr.select(counts, length * dr.pi, 0))

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows = dr.gather(RodRows, self.rows, row, active)
        rod = self.rods.rod(rows.segment, active)
        (before, has_before), (after, has_after) = (self._neighbour(k, active) for k in (rows.previous, rows.next))
        is_side, is_crease, s = rows.part == SIDE, rows.part == CREASE, rows.start + t * rows.length

        n, valid = rod.side_normal(view, rows.side)
        v = dr.select(is_side, s, dr.select(rows.side > 0, 1.0, 0.0))
        n_end, dn, end_valid = rod.end_normal(view, v, s)
        n, valid = dr.select(is_side, n, n_end), dr.select(is_side, valid, end_valid)
        x = mi.Point3f(rod.centre(v) + rod.radius(v) * n)
        dx = dr.select(is_side, rod.dc + rod.dr * n, rod.radius(v) * dn)
        at_joint = has_after & (rows.side > 0)
        free = is_side | (self._beyond(rod, n, rows.side, mi.Bool(True)) & self._beyond(after, n, -1, at_joint))
        for other, there in ((before, has_before), (after, has_after)):
            free &= ~there | (other.height(x) > -SUNK * rod.radius(v)) | (rows.part == END)

        x_crease, dx_crease, crease_valid = crease(rod.centre(1), rod.radius(1), [rod, after], [-1.0, 1.0], s)
        for own in (rod, after):  # seen from outside of both
            away = mi.Vector3f(view.x, view.y, view.z) - view.w * x_crease
            crease_valid &= has_after & (dr.dot(own.place(x_crease)[1], away) > 0)
        x = dr.select(is_crease, x_crease, x)
        offset, lead = clearance(x, rod.radius(v), self.centre)
        offset = dr.maximum(offset, ASIDE * rod.radius(v))
        return OnEdge(
            x=x,
            dx=dr.select(is_crease, dx_crease, dx) * rows.length,
            outward=dr.select(is_crease, 0, n),
            local=mi.Point3f(n),
            scale=rod.radius(v),
            offset=offset,
            lead=lead,
            aside=dr.select(is_crease, 0, offset),
            valid=active & dr.select(is_crease, crease_valid, valid & free),
        )

    def _beyond(self, rod: Rod, n: mi.Vector3f, end: mi.Float | int, there: mi.Bool) -> mi.Bool:
        """Does a point with normal `n` of the sphere at an end (−1 or 1) lie beyond the cone, where it is seen?"""
        u, s = rod.axis
        return ~there | (end * (dr.dot(n, u) + s) >= 0) | ~rod.has_side

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """A ray aimed at a tangent point meets the curve itself: beside it. Before a crease, there is room."""
        is_crease = dr.gather(mi.UInt32, self.rows.part, row, active) == CREASE
        return sight.at.x + dr.select(is_crease, -sight.offset * sight.ω, sight.offset * sight.n_perp)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The curve itself on the side −n_perp, and whatever a ray meets on the other; on both sides of a crease, it is
        the curve.
        """
        rows = dr.gather(RodRows, self.rows, row, active)
        is_crease = rows.part == CREASE
        known = (which == 0) | is_crease
        rod = self.rods.rod(rows.segment, active)
        v = dr.select(rows.part == SIDE, rows.start + sight.at.t * rows.length, dr.select(rows.side > 0, 1.0, 0.0))
        n = dr.normalize(mi.Vector3f(sight.at.local) - TURN * sight.ω)
        x = mi.Point3f(rod.centre(v) + rod.radius(v) * n)
        x_crease, segment = self._beside_crease(rows, rod, sight, which, active & is_crease)
        x, segment = dr.select(is_crease, x_crease, x), dr.select(is_crease, segment, rows.segment)
        return Side.of_segment(self.rods, segment, mi.Point3f(x), sight, which, known & active)

    def _beside_crease(
        self, rows: RodRows, rod: Rod, sight: Sight, which: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Point3f, mi.UInt32]:
        """`(point, segment)` on a side of a crease: each surface leads from it to where the other turns."""
        after, _ = self._neighbour(rows.next, active)
        (_, n), (_, n_after) = (body.place(sight.at.x) for body in (rod, after))
        before = (dr.dot(n_after - dr.dot(n, n_after) * n, sight.n_perp) > 0) == (which == 1)
        normal, other = dr.select(before, n, n_after), dr.select(before, n_after, n)
        body = dr.select(before, rod, after)
        off = dr.normalize(other - dr.dot(normal, other) * normal)
        v, n = body.place(sight.at.x + ASIDE * sight.at.scale * off)
        return mi.Point3f(body.centre(v) + body.radius(v) * n), dr.select(before, rows.segment, rows.next)

    def shades(self, row: mi.UInt32, on: OnEdge, ω: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        return dr.gather(mi.UInt32, self.rows.part, row, active) != CREASE

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of a material point c(v) + r(v) n; of a crease, which belongs to two surfaces, across both."""
        rows = dr.gather(RodRows, self.rows, row, active)
        rod = self.rods.rod(rows.segment, active)
        after, _ = self._neighbour(rows.next, active)
        n, speed = _normal_motion(rod, at.x)
        n_after, speed_after = _normal_motion(after, at.x)
        cos = dr.dot(n, n_after)
        room = 1 - dr.square(cos)
        both = n * (speed - cos * speed_after) + n_after * (speed_after - cos * speed)
        both = dr.select(room > SHALLOW * SHALLOW, both / room, n * speed)
        moved = dr.select(rows.part == CREASE, both, n * speed)
        return dr.select(active, moved, 0)


def _normal_motion(rod: Rod, x: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
    """`(n, displacement along it)` of the surface at `x`; the first detached, the second of value 0."""
    v, n = (dr.detach(a) for a in rod.place(dr.detach(x)))
    place = dr.dot(n, rod.centre(v)) + rod.radius(v)
    return n, place - dr.detach(place)
