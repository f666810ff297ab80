"""Curves along which two surfaces cut into each other, with a motion of their own (`junctions`)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame
from ..scene.surfaces import Surfaces
from .film_cover import EdgeOnFilm, straight_cover
from .junction_points import bend, junction_motion, on_a_ball
from .junctions import JunctionRows
from .kind import OnEdge, Side, Sight, Use
from .kind_mesh import BetweenFaces, on_fixed, straight_point
from .lights import LightBounds
from .location import EdgeLocation
from .points import ROUNDING_LEAD, clear_of_lift, cot_between
from .rows import EdgeRows
from .wedges import Wedges, meeting_wedges

#: Share of the distance to the viewer that a ray to the side starts before the curve, at most.
NEAREST = 0.1


@dataclass(frozen=True)
class Junctions(BetweenFaces):
    """Segments between triangles, and arcs between a ball and triangles, as edges between both surfaces."""

    rows: EdgeRows
    index: mi.UInt32  # by row: entry of `curves`
    curves: JunctionRows
    centre: mi.Point3f  # of the scene
    surfaces: Surfaces | None
    transparent: mi.Bool  # by row: is one of the surfaces a light that the sensor looks through?

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """Being behind one of the surfaces is enough to be hidden."""
        seen = EdgeOnFilm.of(self.rows, frame)
        return straight_cover(self.rows, frame, border, mi.Float(1), seen.behind0 | seen.behind1)

    def line_weights(self, use: Use) -> mi.Float:
        """Both surfaces block the light: nothing passes such a curve, so it casts no shadow."""
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        return dr.norm(self.rows.p1 - self.rows.p0) * meeting_wedges(self.rows).measure

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def wedges(self, row: mi.UInt32, use: Use, active: mi.Bool) -> Wedges:
        return meeting_wedges(dr.gather(EdgeRows, self.rows, row, active))

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        index = dr.gather(mi.UInt32, self.index, row, active)
        x, dx = bend(self.curves, index, *straight_point(self.rows, row, t, active), active)
        on = on_fixed(x, dx, self.centre, mi.Float(0), active)
        on.lead += ROUNDING_LEAD * self._in_the_dark(row, x, active)
        return on

    def _in_the_dark(self, row: mi.UInt32, x: mi.Point3f, active: mi.Bool) -> mi.Float:
        """How far beside the curve a point of one surface is in the shadow of the other, if that overhangs [m].

        Mitsuba lifts rays off a surface along its normal, by h: where the surfaces meet at an angle φ (cos φ = n0·n1),
        closer to the curve than h cot φ they start behind what overhangs. Distances are along the surface.
        """
        return clear_of_lift(x) * cot_between(*self.normals(row, active))

    def open_side(self, row: mi.UInt32, dx: mi.Vector3f, ω: mi.Vector3f, active: mi.Bool):
        side = dr.cross(dx, ω)
        across = dr.norm(side)
        return dr.select(across > 0, side / across, 0), across, mi.Bool(False)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """As far to the side as leads out of the dark on the surface in front there, and no farther.

        Along a surface seen at a grazing angle, a step to the side is many times as long, and would lead across the
        thin shadow that begins at the curve. Of a step along a surface with normal n, |n·ω| / |ω × curve| leads to the
        side; in front is the surface with the larger n·s/(n·ω), s the direction to the side. So much nearer, for a step
        of 1, the ray has to start: else it begins behind a surface that is seen at a grazing angle. A light that the
        sensor looks through is not what is seen in front: the whole way is gone there. Next to a sphere that is none
        too short: closer, Mitsuba's samples of its light are not to be relied on (half of the step was missing).
        """
        n0, n1 = self.normals(row, active)
        s = dr.select(which == 0, -1.0, 1.0) * sight.n_perp
        across = dr.norm(dr.cross(sight.ω, dr.normalize(dr.cross(n0, n1))))
        f0, f1 = dr.dot(n0, sight.ω), dr.dot(n1, sight.ω)
        nearer0, nearer1 = dr.dot(n0, s) / f0, dr.dot(n1, s) / f1  # by which a step of 1 to the side meets each
        in_front = dr.abs(dr.select(nearer0 > nearer1, f0, f1))
        through = dr.gather(mi.Bool, self.transparent, row, active)
        share = dr.select(~through & (in_front < across), in_front / across, 1)
        dark = self._in_the_dark(row, sight.at.x, active)
        by_lamp = through & on_a_ball(self.curves, dr.gather(mi.UInt32, self.index, row, active), active)
        dark = dr.select(by_lamp, dr.maximum(dark, clear_of_lift(sight.at.x)), dark)
        step = sight.offset + share * dark
        nearer = dr.clip(step * dr.maximum(nearer0, nearer1), 0, NEAREST * sight.r)
        return Side.found_by(mi.Ray3f(sight.at.x + step * s - (sight.lead + nearer) * sight.ω, sight.ω))

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        index = dr.gather(mi.UInt32, self.index, row, active)
        return dr.select(active, junction_motion(self.curves, index, at.t, dr.detach(at.x), self.surfaces, active), 0)
