"""Where bent normals turn from the viewer: curves on surfaces with bump or normal maps.

Where h = n(x)·ω = 0, with ω the direction of view and n the unit normal that the map bends, Mitsuba turns the normal
over, or the nested BSDF ends: what a point x sends along −ω steps. The curves move as those of interpolated normals do
(`kind_within_faces`), with ∇h the gradient within the surface for a fixed ω. From behind, a surface that is two-sided
outside of its map has the normal n − 2 (n·n_s) n_s, n_s the one before bending.

*From a viewpoint* o they are met on ways across the patch (`bent_ways`), of density D per area in b and per change of
h. With ∂_i = ∂/∂b_i, a sample stands for |∂_1 x × ∂_2 x| / D, a length of curve times |∇h|.

*Lines from anywhere*: b is uniform, and ω on that half of the great circle across n that looks at a side of the surface
(`kind_within_faces` says why).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, towards_viewer
from .bent_looks import ASIDE, UNLIKELY
from .bent_rows import BentRows
from .bent_seen import SeenPatches
from .bent_surface import Bent, BentSurface, PatchPoint
from .bent_ways import on_patch, way_across
from .kind import EdgeKind, Line, OnEdge, Side, Sight, Use, Views
from .lights import LightBounds
from .location import EdgeLocation
from .points import clearance, facing

#: Sine up to which a root is one: beyond, h steps across 0.
CLOSE = 1e-4

#: Cosine between the view and the normal before bending up to which the curve is taken to be where that one turns away
#: itself: normals that are not bent do so at the outline, or where smooth shading ends, which are edges of their own.
NOT_BENT = 2e-4

#: Step to the side at which the radiance of the surface is taken, in units of b per texel.
STEP_ASIDE = 2e-3


@dataclass(frozen=True)
class BentOutlines(EdgeKind):
    """One row per patch and map; most of them are crossed by no curve."""

    blocks_light: ClassVar[bool] = False
    near_outlines: ClassVar[bool] = True
    shades_only: ClassVar[bool] = True

    rows: BentRows
    surface: BentSurface
    seen: SeenPatches  # by the sensor
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.rows.part)

    def moving(self) -> mi.Bool:
        return self.rows.moves

    def places(self) -> mi.Point3f:
        return self.seen.corners[0].x

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """`frame` is that of `seen`."""
        return self.seen.film_weights(border)

    def line_weights(self, use: Use) -> mi.Float:
        """Area × mean |∇h| × the angle of the great circle, halved as an edge's azimuths are (4π sr count as 2π), in
        proportion to the step.
        """
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        start, *others = self.seen.looks.at[:3]
        dx = [mi.Vector3f(look.x - start.x) / ASIDE for look in others]
        dn = [mi.Vector3f(look.n - start.n) / ASIDE for look in others]
        bend2 = dr.squared_norm(dn[0]) * dr.squared_norm(dx[1]) + dr.squared_norm(dn[1]) * dr.squared_norm(dx[0])
        bend2 -= 2 * dr.dot(*dn) * dr.dot(*dx)
        # over |∂_1 x × ∂_2 x|, which is twice the area
        weight = dr.safe_sqrt(bend2 / 2) / 2 + UNLIKELY * dr.norm(dr.cross(*dx))
        sides = dr.select(self.rows.front, 0.5, 0) + dr.select(self.rows.back, 0.5, 0)
        weight *= sides * dr.pi * self.seen.looks.step
        return dr.select(dr.isfinite(weight), weight, 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows = dr.gather(BentRows, self.rows, row, active)
        way = way_across(self.surface, rows, t, self.seen.cell(row, rows, t, active), view, active)
        r = self.surface.turns_away(rows, way.start, way.along, way.h, view, way.exists)
        b = mi.Point2f(way.start + r * way.along)
        bent = self.surface.bent(rows, b, way.exists)
        towards = towards_viewer(view, bent.x)
        side = self.surface.side_seen(rows, bent, towards)
        at = self.surface.at(rows, b, side, way.exists)
        distance = dr.norm(towards)
        slope = mi.Vector2f(*(dr.dot(n, towards) - view.w * dr.dot(at.n, x) for n, x in zip(at.dn, at.dx, strict=True)))
        ω = -towards / distance
        crosses = way.exists & on_patch(b) & (dr.abs(dr.dot(at.n, ω)) < CLOSE)
        crosses &= _is_bent(bent, ω)
        return self._point(rows, at, b, side, ω, at.density / way.met(r, slope / distance), crosses)

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        rows = dr.gather(BentRows, self.rows, row, active)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(t, u.x))
        both = rows.front & rows.back
        turn = dr.select(both, 2 * u.y, u.y)
        outside = dr.select(both, turn < 1, rows.front)
        φ = (dr.select(both & ~outside, turn - 1, turn) - 0.5) * dr.pi
        bent = self.surface.bent(rows, b, active)
        n_g = self.surface.normal(rows, self.surface.place(rows, rows.q(b), active))
        side = dr.select((dr.dot(bent.n_s, n_g) > 0) == outside, mi.Float(1), -1)
        at = self.surface.at(rows, b, side, active)
        # of the directions across n, `inwards` leads deepest below n_s
        inwards = side * (at.n * dr.dot(at.n, bent.n_s) - bent.n_s)
        size = dr.norm(inwards)
        inwards = dr.select(size > 0, inwards / size, mi.coordinate_system(at.n)[0])
        sin, cos = dr.sincos(φ)
        ω = mi.Vector3f(cos * inwards + sin * dr.cross(at.n, inwards))
        pdf = dr.rcp(dr.select(both, dr.two_pi, dr.pi))
        on = self._point(rows, at, b, side, ω, at.density / 2, active & _is_bent(bent, ω))
        return Line(on, ω, pdf, dr.select(both & ~rows.mirrored, pdf, 0))

    def _point(self, rows, at: PatchPoint, b: mi.Point2f, side, ω: mi.Vector3f, weight: mi.Float, valid) -> OnEdge:
        """A point of the curve of direction ω; `weight`: of the curve, per unit of its parameter and of |∇h|."""
        towards = facing(at.n_g, -ω)
        seen = ((towards > 0) & rows.front) | ((towards < 0) & rows.back)
        offset, lead = clearance(at.x, at.size, self.centre)
        nothing = mi.Float(0)
        return OnEdge(
            x=at.x,
            dx=dr.cross(at.n_g, at.gradient(ω)) * weight,
            outward=mi.Vector3f(0),
            local=mi.Point3f(b.x, b.y, side),
            scale=nothing,
            offset=offset,
            lead=lead,
            aside=nothing,
            valid=valid & seen & dr.isfinite(weight),
        )

    def _located(self, row: mi.UInt32, at: EdgeLocation, active: mi.Bool) -> tuple[BentRows, mi.Point2f, PatchPoint]:
        rows = dr.gather(BentRows, self.rows, row, active)
        b = mi.Point2f(dr.detach(at.local.x), dr.detach(at.local.y))
        return rows, b, self.surface.at(rows, b, dr.detach(at.local.z), active)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The surface itself, a step away from the curve. On the side that n_perp leads to, h is larger if ∇h does."""
        rows, b, at = self._located(row, sight.at, active)
        larger = dr.select(which == 0, -1.0, 1.0) * dr.sign(dr.dot(at.gradient(sight.ω), sight.n_perp))
        step = at.barycentric(at.gradient_from(sight.ω, sight.r)) * larger
        step *= STEP_ASIDE / (dr.maximum(rows.texels, 1) * dr.maximum(dr.abs(step.x), dr.abs(step.y)))
        q = rows.q(mi.Point2f(b + dr.select(active, step, 0)))
        pi, way = self.surface.met(rows, q, active)[1], self.surface.place(rows, q, active).x - sight.viewer
        pi.t = dr.select(active, dr.norm(way), dr.inf)
        return Side(mi.Ray3f(sight.viewer, way / pi.t), pi, mi.Bool(False), own=mi.Bool(False), differs=mi.Bool(True))

    def lies_in(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Normal3f:
        rows = dr.gather(BentRows, self.rows, row, active)
        return self.surface.flat_normal(rows, rows.q(mi.Point2f(sight.at.local.x, sight.at.local.y)), active)

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Material velocity, and −ḣ/|∇h| along m."""
        with dr.suspend_grad():
            rows, b, here = self._located(row, at, active)
            m, direction = here.gradient(ω), dr.detach(ω)
            per_h = dr.select(active, m * dr.rcp(dr.squared_norm(m)), 0)
        moved = self.surface.attached_bent(rows, b, active)
        h = dr.dot(moved.seen_from(dr.detach(at.local.z), rows.mirrored), direction)
        return mi.Vector3f(moved.x - dr.detach(moved.x)) - per_h * (h - dr.detach(h))

    def turn(
        self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f, active: mi.Bool
    ) -> mi.Vector3f:
        _, _, here = self._located(row, at, active)
        m = here.gradient(ω)
        return mi.Vector3f(-here.n * dr.select(active, dr.dot(m, n_perp) / dr.squared_norm(m), 0))


def _is_bent(at: Bent, ω: mi.Vector3f) -> mi.Bool:
    """Does the normal turn from ω somewhere else than it would if it were not bent?"""
    return dr.abs(dr.dot(at.n_s, ω)) > NOT_BENT
