"""Shading outlines of grids of signed distances: where blended normals turn away from the viewer.

As on smooth-shaded faces (`kind_within_faces`), what a point x sends along −ω steps where h = n(x)·ω = 0. Here n is the
blended normal (`core.sdf_octant`), and ∇h its gradient within the surface for a fixed ω. Rows are pieces of octants of
the surface; on them a point is given by X and Z (`octant_curve`).

*From a viewpoint* o the curve is met at a fixed Z by halving and Newton's method in X. Per unit of Z it weighs
|∇h| |∂x/∂Z × ∂x/∂X| / |∂h/∂X|, with h as seen from o. It counts where Z changes fastest along it.

*Lines from anywhere*: x is uniform in X and Z, weighed by |∂x/∂Z × ∂x/∂X|, and ω on the great circle across n. Pieces
count where f changes fastest along Y, each of the two whose axis Y is the same for one half.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.memory import Memory
from ..core.sdf_octant import REACH
from ..core.sensor_frame import SensorFrame, viewpoint
from ..core.surface_code import set_surface
from ..scene.grids import TO_WORLD, VALUES, blends_normals
from .film_cover import LENS_CENTRE, outline_cover
from .grid_set import Frame, GridSet
from .kind import EdgeKind, Line, OnEdge, Side, Sight, Use, Views
from .kind_grid import OFF_ROUNDING
from .lights import LightBounds
from .location import EdgeLocation
from .octant_curve import Patch
from .octant_set import OctantRows, along_grid, octant_frame, octant_patch, octant_rows
from .points import clearance

#: Step to the side at which the radiance of the surface is taken, in units of a cell.
STEP_ASIDE = 2e-3

#: Where on a row the film's weights look for the curve.
LOOKED_AT = (0.05, 0.275, 0.5, 0.725, 0.95)

#: Share of the weight of a row that the curve may cross, where it was not found at these places.
UNLIKELY = 0.02


@dataclass
class _At:
    """A point of a row: the surface and its blended normal there, in coordinates of the octant."""

    frame: Frame
    patch: Patch
    p: mi.Vector3f
    valid: mi.Bool

    @property
    def x(self) -> mi.Point3f:
        return self.frame.to_world(self.p)

    @property
    def size(self) -> mi.Float:
        """Of a cell [m]."""
        return dr.norm(self.frame.axes[0])

    def ascent(self, ω: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
        """In the world `(blended normal, ∇h, unit normal of the surface)`; the first of any length."""
        n, g = self.patch.octant.ascent(self.p, self.frame.direction(ω))
        n_g = dr.normalize(self.frame.gradient(self.patch.cell.gradient(self.p)))
        g = self.frame.gradient(g)
        return self.frame.gradient(n), g - n_g * dr.dot(n_g, g), n_g

    @property
    def area(self) -> mi.Float:
        """|∂x/∂Z × ∂x/∂X| [m²]."""
        f = self.patch.cell.gradient(self.p)
        along_x, along_z = mi.Vector3f(1, -f.x / f.y, 0), mi.Vector3f(0, -f.z / f.y, 1)
        return dr.norm(dr.cross(self.frame.vector(along_z), self.frame.vector(along_x)))


@dataclass(frozen=True)
class GridShadingOutlines(EdgeKind):
    """One row per piece of an octant; most of them are crossed by no curve."""

    blocks_light: ClassVar[bool] = False
    shades_only: ClassVar[bool] = True

    grids: GridSet
    rows: OctantRows
    centre: mi.Point3f  # of the scene

    @staticmethod
    def of(grids: GridSet, memory: Memory, centre: mi.Point3f) -> GridShadingOutlines | None:
        """None if no grid is shaded with blended normals."""
        chosen = [k for k, place in enumerate(grids.places) if blends_normals(place.shape, memory)]
        return GridShadingOutlines(grids, octant_rows(grids, chosen, memory), centre) if chosen else None

    @property
    def count(self) -> int:
        return dr.width(self.rows.rises)

    def moving(self) -> mi.Bool:
        return self.rows.moves

    def places(self) -> mi.Point3f:
        return octant_frame(self.grids, self.rows, mi.Bool(True)).to_world(mi.Vector3f(REACH / 2))

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """That of the diagonal of the octant; 0 where a pinhole sees no normal turn."""
        eye, everywhere = viewpoint(frame, mi.Point2f(LENS_CENTRE)), mi.Bool(True)
        place, patch = self._place(self.rows, everywhere)
        cover = outline_cover(frame, border, [place.to_world(mi.Vector3f(REACH * a)) for a in (0.0, 0.5, 1.0)])
        found = mi.Bool(False)
        for t in LOOKED_AT:
            found |= self._turning(self.rows, mi.Float(t), eye, everywhere).valid
        may = dr.select(frame.kind == "thinlens", True, patch.may_turn(place.view(eye)))
        likely = found | (frame.kind == "thinlens")
        return dr.select(may, cover * dr.select(likely, 1, UNLIKELY), 0)

    def line_weights(self, use: Use) -> mi.Float:
        """Area × mean |∇h| × the angle of the great circle, halved as an edge's azimuths are (4π sr count as 2π)."""
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        at, area = self._anywhere(self.rows, mi.Float(0.5), mi.Float(0.5), mi.Bool(True))
        bend2 = mi.Float(0)
        for axis in range(3):
            q = mi.Vector3f(0)
            q[axis] = 1
            n, m, _ = at.ascent(q)
            bend2 += dr.squared_norm(m)
        weight = area * dr.sqrt(0.5 * bend2) / dr.norm(n) * dr.pi
        return dr.select(dr.isfinite(weight), dr.maximum(weight, self._least(at)), 0)

    def _least(self, at: _At) -> mi.Float:
        """Of a row that its middle may say nothing about."""
        return UNLIKELY * dr.square(at.size)

    def _place(self, rows: OctantRows, active: mi.Bool) -> tuple[Frame, Patch]:
        return octant_frame(self.grids, rows, active), octant_patch(self.grids, rows, active)

    def _turning(self, rows: OctantRows, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> _At:
        """Where blended normals turn from a viewpoint, where Z changes fastest along that curve."""
        frame, patch = self._place(rows, active)
        local = frame.view(view)
        p, exists = patch.turns_away(REACH * t, local)
        q = mi.Vector3f(local.x, local.y, local.z) - local.w * p
        n, g = patch.octant.ascent(p, q)
        along = dr.cross(patch.cell.gradient(p), g - local.w * n)
        fastest = dr.abs(along.z) >= dr.maximum(dr.abs(along.x), dr.abs(along.y))
        return _At(frame, patch, p, active & exists & fastest & (along.z != 0))

    def _anywhere(self, rows: OctantRows, t: mi.Float, u: mi.Float, active: mi.Bool) -> tuple[_At, mi.Float]:
        """A point of the surface, and the area [m²] that stands for it; 0 where another row has it."""
        frame, patch = self._place(rows, active)
        span = patch.span(REACH * t)
        p = span.at(dr.lerp(span.start, span.end, u))
        f = patch.cell.gradient(p)
        steepest = dr.abs(f.y) >= dr.maximum(dr.abs(f.x), dr.abs(f.z))
        at = _At(frame, patch, p, active & (span.start < span.end) & steepest & (f.y != 0))
        return at, dr.select(at.valid, at.area * REACH * (span.end - span.start) / 2, 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows = dr.gather(OctantRows, self.rows, row, active)
        at = self._turning(rows, t, view, active)
        local = at.frame.view(view)
        towards = mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(at.x)
        distance = dr.norm(towards)
        q = mi.Vector3f(local.x, local.y, local.z) - local.w * at.p
        n, g = at.patch.octant.ascent(at.p, q)
        f = at.patch.cell.gradient(at.p)
        by_x = g - local.w * n
        slope = dr.abs(by_x.x - by_x.y * f.x / f.y) / distance  # |∂h/∂X|
        return self._point(at, -towards / distance, REACH * at.area / slope)

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        rows = dr.gather(OctantRows, self.rows, row, active)
        at, area = self._anywhere(rows, t, u.x, active)
        n = at.frame.gradient(at.patch.octant.blended(at.p))
        length = dr.norm(n)
        a, b = mi.coordinate_system(n / length)
        sin, cos = dr.sincos(u.y * dr.two_pi)
        ω = mi.Vector3f(cos * a + sin * b)
        pdf = mi.Float(dr.rcp(dr.two_pi))
        return Line(self._point(at, ω, area / length), ω, pdf, pdf)

    def _point(self, at: _At, ω: mi.Vector3f, weight: mi.Float) -> OnEdge:
        """A point of the curve of direction ω; `weight`: of the curve, per unit of its parameter and of |∇h|."""
        _, m, n_g = at.ascent(ω)
        x, nothing = at.x, mi.Float(0)
        offset, lead = clearance(x, at.size, self.centre)
        valid = at.valid & dr.isfinite(weight)
        dx = dr.cross(n_g, m) * weight
        return OnEdge(x, dx, mi.Vector3f(0), mi.Point3f(at.p), at.size, offset, lead, nothing, valid)

    def _seen(self, row: mi.UInt32, local: mi.Point3f, active: mi.Bool) -> tuple[OctantRows, _At]:
        rows = dr.gather(OctantRows, self.rows, row, active)
        return rows, _At(*self._place(rows, active), mi.Vector3f(local), active)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The surface itself, a step away from the curve."""
        rows, at = self._seen(row, sight.at.local, active)
        _, m, _ = at.ascent(sight.ω)
        towards = dr.select(which == 0, -1.0, 1.0) * dr.sign(dr.dot(m, sight.n_perp))
        step = dr.maximum(STEP_ASIDE * at.size, OFF_ROUNDING * dr.max(dr.abs(sight.at.x)))
        x = sight.at.x + step * towards * m / dr.maximum(dr.norm(m), dr.smallest(mi.Float))
        x = self.grids.onto(rows.grid, x, active)
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(active, sight.r, dr.inf)
        set_surface(pi, dr.select(active, dr.gather(mi.UInt32, self.grids.code, rows.grid, active), 0))
        ray = mi.Ray3f(x - sight.r * sight.ω, sight.ω)
        return Side(ray, pi, mi.Bool(False), own=mi.Bool(False), differs=mi.Bool(True))

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Before it, there is room."""
        return sight.at.x - sight.offset * sight.ω

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of the surface, and −ḣ/|∇h| along m."""
        if not any(place.facts.moves for place in self.grids.places):
            return mi.Vector3f(0)
        with dr.suspend_grad():
            rows, here = self._seen(row, at.local, active)
            _, m, _ = here.ascent(ω)
            per_h = dr.select(active & (dr.squared_norm(m) > 0), m * dr.rcp(dr.squared_norm(m)), 0)
        found = mi.Vector3f(0)
        for k, place in enumerate(self.grids.places):
            if place.facts.moves:
                mine = active & (rows.grid == k)
                x, n = self._attached(place.shape, rows, here, mine)
                h = dr.dot(n, ω)
                moved = mi.Vector3f(x - dr.detach(x)) - per_h * (h - dr.detach(h))
                found = dr.select(mine, moved, found)
        return found

    def _attached(self, shape: mi.Shape, rows: OctantRows, here: _At, active: mi.Bool):
        """`(x, blended normal)` of the point of a grid, attached to its values, along the surface's normal, and place.

        The normal has the length that it has in `_At.ascent`.
        """
        params = mi.traverse(shape)
        octant, p = here.patch.octant, here.p
        if dr.grad_enabled(params[VALUES]):
            octant = octant_patch(self.grids, rows, active, mi.Float(params[VALUES].array)).octant
            with dr.suspend_grad():
                f = here.patch.cell.gradient(p)
                down = f / dr.maximum(dr.squared_norm(f), dr.smallest(mi.Float))
            value = octant.cell.value(p)
            p = p - down * (value - dr.detach(value))
        cells = mi.Float(dr.select(active, dr.gather(mi.UInt32, self.grids.size, rows.grid, active), 2) - 1)
        n, to_world = octant.blended(p), params[TO_WORLD]
        q = (mi.Vector3f(rows.corner) + along_grid(rows, p)) / cells
        return mi.Vector3f(to_world @ mi.Point3f(q)), mi.Vector3f(to_world @ mi.Normal3f(along_grid(rows, n) * cells))

    def turn(
        self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f, active: mi.Bool
    ) -> mi.Vector3f:
        _, here = self._seen(row, at.local, active)
        n, m, _ = here.ascent(ω)
        slope2 = dr.squared_norm(m)
        return mi.Vector3f(-n * dr.select(slope2 > 0, dr.dot(m, n_perp) / slope2, 0))
