"""Edges of grids of signed distances (`core.sdf_cell`, `grid_rows`): outlines within cells, creases between them, and
borders where the surface leaves the grid.

A crease is an outline where one of its two cells turns to the viewer and the other away. Where both are seen, radiance
steps there if Mitsuba shades with the normals of the cells, or these differ much (`stepped`). The surface is seen from
both sides: which of them an outline leads off tells the curvature along the line of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sdf_cell import Cell, across_face
from ..core.sensor_frame import SensorFrame, viewpoint
from ..core.surface_code import set_surface
from .film_cover import LENS_CENTRE, outline_cover
from .geometry import UNIT_ROUNDOFF
from .grid_motion import crease_motion, surface_motion
from .grid_rows import BORDER, CREASE, OUTLINE
from .grid_set import Frame, GridRows, GridSet, cells_of
from .kind import ContourKind, OnEdge, Side, Sight, Use
from .location import EdgeLocation
from .points import clearance

#: Steps off an edge in units of a cell, clear of how exactly Mitsuba meets the surface.
ASIDE = 2e-3

#: How far off an edge the surface itself is looked at, in units of a cell.
OFF = 1e-2

#: The same off a step: another may be near, as where the surface passes close by an edge between four cells.
OFF_STEP = 2e-4

#: ... but clear of how exactly a point is known, relative to its coordinates.
OFF_ROUNDING = 16 * UNIT_ROUNDOFF

#: Share of the weight of a crease that is seen from one side at the points where it is looked at.
UNLIKELY = 0.02


@dataclass
class _At:
    """A point of a row, with the cells about it."""

    rows: GridRows
    frame: Frame
    cell: Cell  # of an outline; of a face, that above it
    below: Cell
    p: mi.Vector3f  # in coordinates of `cell`
    dp: mi.Vector3f  # by the parameter of the row
    q: mi.Vector3f  # towards the viewer, in these coordinates
    valid: mi.Bool

    @property
    def under(self) -> mi.Vector3f:
        """The point in coordinates of the cell below."""
        return self.p + mi.Vector3f(0, 0, 1)


@dataclass(frozen=True)
class GridEdges(ContourKind):
    """Pieces of the edges of grids."""

    grids: GridSet
    stepped: mi.UInt32  # by grid: 1 if creases are steps of radiance
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.grids.rows.base)

    def moving(self) -> mi.Bool:
        return self.grids.rows.moves

    def _middle(self, rows: GridRows, active: mi.Bool) -> tuple[Frame, mi.Vector3f]:
        """Roughly where rows are."""
        frame = self.grids.frame(rows, active)
        return frame, mi.Vector3f(0.5, 0.5, dr.select(rows.part == OUTLINE, 0.5, 0.0))

    def places(self) -> mi.Point3f:
        frame, middle = self._middle(self.grids.rows, mi.Bool(True))
        return frame.to_world(middle)

    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        frame, middle = self._middle(dr.gather(GridRows, self.grids.rows, row, active), active)
        return frame.to_world(middle)

    def line_weights(self, use: Use) -> mi.Float:
        frame, _ = self._middle(self.grids.rows, mi.Bool(True))
        return self.grids.rows.weight * _size(frame)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """That of the diagonal of the cell, or of the piece of a face; 0 where a pinhole sees no outline of a cell."""
        rows, eye = self.grids.rows, viewpoint(frame, mi.Point2f(LENS_CENTRE))
        everywhere = mi.Bool(True)
        cell_frame = self.grids.frame(rows, everywhere)
        cover = outline_cover(frame, border, [cell_frame.to_world(mi.Vector3f(a)) for a in (0.0, 0.5, 1.0)])
        cell = cells_of(self.grids.layers(rows, everywhere))[1]
        view = cell_frame.view(eye)
        likely = dr.select(frame.kind == "thinlens", True, _may_be_outline(cell, view))
        seen, steps = mi.Bool(False), dr.gather(mi.UInt32, self.stepped, rows.grid) != 0
        for t in (0.0, 0.25, 0.5, 0.75, 1.0):
            at = self._at(rows, mi.Float(t), eye, everywhere)
            seen |= self._crease(at)[1]
        share = dr.select(seen | steps | (rows.part == BORDER), 1, UNLIKELY)
        return cover * dr.select(rows.part == OUTLINE, dr.select(likely, 1.0 / 6, 0), rows.length * share)

    def _at(self, rows: GridRows, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> _At:
        frame = self.grids.frame(rows, active)
        layers = self.grids.layers(rows, active)
        below, cell = cells_of(layers)
        local = frame.view(view)
        is_outline, s = rows.part == OUTLINE, rows.start + t * rows.length
        p, valid = cell.outline(s, local, rows.root)
        along = cell.along_outline(p, local)
        steepest = dr.maximum(dr.abs(along.x), dr.abs(along.y))
        valid &= (dr.abs(along.z) >= steepest) & (along.z != 0)
        y, dy = across_face(layers[1], s)
        p = dr.select(is_outline, p, mi.Vector3f(s, y, 0))
        dp = dr.select(is_outline, along / along.z, mi.Vector3f(1, dy, 0)) * rows.length
        q = mi.Vector3f(local.x, local.y, local.z) - local.w * p
        return _At(rows, frame, cell, below, p, dp, q, active & (~is_outline | valid))

    def _crease(self, at: _At) -> tuple[mi.Vector3f, mi.Bool, mi.Bool]:
        """`(outward, is an outline, both cells turn the same side to the viewer)`, of a face; local gradient."""
        above, below = at.cell.gradient(at.p), at.below.gradient(at.under)
        facing, facing_below = dr.dot(above, at.q), dr.dot(below, at.q)
        both = at.rows.low & at.rows.high
        outline = both & (facing * facing_below < 0)
        # along the line of sight, f falls and then rises on the convex side; the cell behind is that q points off
        rises = dr.select(at.q.z > 0, facing > 0, facing_below > 0)
        outward = dr.select(rises, above + below, -above - below)
        return outward, outline, both & (facing * facing_below > 0)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows = dr.gather(GridRows, self.grids.rows, row, active)
        at = self._at(rows, t, view, active)
        is_outline, is_border = rows.part == OUTLINE, rows.part == BORDER
        bulges = dr.dot(at.cell.bend(at.p, at.q), at.q) > 0
        gradient = at.cell.gradient(at.p)
        outward, turns, _ = self._crease(at)
        outward = dr.select(is_outline, dr.select(bulges, gradient, -gradient), dr.select(turns, outward, 0))
        # at the border, away from the cell within its surface
        rim = dr.select(rows.high, -1.0, 1.0) * _into_cell(at)
        step = dr.gather(mi.UInt32, self.stepped, rows.grid, active) != 0
        valid = at.valid & (is_outline | is_border | turns | step)
        x, size = at.frame.to_world(at.p), _size(at.frame)
        offset, lead = clearance(x, size, self.centre)
        offset = dr.maximum(offset, ASIDE * size)
        outward = dr.select(is_border, rim, at.frame.gradient(outward))
        tangent = is_outline | turns
        aside = dr.select(tangent, offset, 0)
        return OnEdge(x, at.frame.vector(at.dp), outward, mi.Point3f(at.p), size, offset, lead, aside, valid)

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Beside an outline; before a step, there is room."""
        at = self._seen(row, sight, active)
        tangent = (at.rows.part != CREASE) | self._crease(at)[1]
        return sight.at.x + sight.offset * dr.select(tangent, sight.n_perp, -sight.ω)

    def _seen(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> _At:
        """The point that is looked at, for its viewer."""
        rows = dr.gather(GridRows, self.grids.rows, row, active)
        view = mi.Vector4f(-sight.ω.x, -sight.ω.y, -sight.ω.z, 0)
        at = self._at(rows, sight.at.t, view, active)
        at.p = mi.Vector3f(sight.at.local)  # an outline for another viewpoint would be elsewhere
        return at

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The surface itself on the side −n_perp, and whatever a ray meets on the other; on both sides of a step, it is
        the surface. It is never shot at: what it looks like there is known better than a ray meets it.
        """
        at = self._seen(row, sight, active)
        _, turns, _ = self._crease(at)
        is_step = (at.rows.part == CREASE) & ~turns
        x = self._beside(at, sight, which, turns)
        known = (which == 0) | is_step
        pi = self._on_surface(at, sight.r, known & active)
        beside = sight.beside(which)
        ray = mi.Ray3f(dr.select(known, x - sight.r * sight.ω, beside.o), beside.d)
        return Side(ray, pi, ~known, known, mi.Bool(True))

    def _beside(self, at: _At, sight: Sight, which: mi.UInt32, turns: mi.Bool) -> mi.Point3f:
        """A point of the surface a little off the edge: of an outline towards the viewer, of others across the edge."""
        is_outline = at.rows.part == OUTLINE
        across = _into_cell(at)
        above = dr.select(which == 0, -1.0, 1.0) * dr.dot(across, sight.n_perp) > 0
        above = dr.select(turns, at.q.z > 0, dr.select(at.rows.part == BORDER, at.rows.high, above))
        cell_p = dr.select(is_outline | above, at.p, at.under)
        gradient = dr.select(is_outline | above, at.cell.gradient(at.p), at.below.gradient(at.under))
        off = dr.cross(at.dp, gradient)  # within the surface, across the face
        off = off * dr.sign(off.z) * dr.select(above, 1.0, -1.0)
        off = dr.select(is_outline, at.q, off)
        rounding = OFF_ROUNDING * dr.max(dr.abs(sight.at.x)) / _size(at.frame)
        is_step = (at.rows.part == CREASE) & ~turns
        step = dr.select(is_step, dr.clip(rounding, OFF_STEP, OFF), OFF)
        cell_p = cell_p + step * off / dr.maximum(dr.norm(off), dr.smallest(mi.Float))
        value = dr.select(is_outline | above, at.cell.value(cell_p), at.below.value(cell_p))
        cell_p = cell_p - value / dr.squared_norm(gradient) * gradient
        return at.frame.to_world(dr.select(is_outline | above, cell_p, cell_p - mi.Vector3f(0, 0, 1)))

    def _on_surface(self, at: _At, t: mi.Float, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """The surface, met at the distance `t`."""
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(active, t, dr.inf)
        set_surface(pi, dr.select(active, dr.gather(mi.UInt32, self.grids.code, at.rows.grid, active), 0))
        return pi

    def shades(self, row: mi.UInt32, on: OnEdge, ω: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        return dr.squared_norm(on.outward) > 0

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of the surface along its normal; of a curve on a face, across it within the moving face."""
        rows = dr.gather(GridRows, self.grids.rows, row, active)
        if not any(place.facts.moves for place in self.grids.places):
            return mi.Vector3f(0)
        frame = self.grids.frame(rows, active)
        n, moved, rigid = surface_motion(self.grids, rows, frame, mi.Vector3f(at.local), active)
        found = dr.select(rows.part == OUTLINE, n * moved, crease_motion(frame, n, moved, rigid))
        return dr.select(active, found, 0)


def _size(frame: Frame) -> mi.Float:
    """Of a cell [m]."""
    return dr.maximum(dr.maximum(dr.norm(frame.axes[0]), dr.norm(frame.axes[1])), dr.norm(frame.axes[2]))


def _into_cell(at: _At) -> mi.Vector3f:
    """World direction within the surface, across the edge, into the cell above the face."""
    gradient = dr.select(at.rows.high, at.cell.gradient(at.p), at.below.gradient(at.under))
    across = dr.cross(at.dp, gradient)
    return at.frame.vector(across * dr.sign(across.z))


def _may_be_outline(cell: Cell, view: mi.Vector4f) -> mi.Bool:
    """Can ∇f·(e − w p) be 0 somewhere in the cell? By bounds: each slope is between those of four sides of the cell."""
    f = [*cell.low, *cell.high]
    lower, upper = mi.Float(0), mi.Float(0)
    for axis, e in enumerate((view.x, view.y, view.z)):
        step = 1 << axis
        slopes = [f[i + step] - f[i] for i in range(8) if not i & step]
        least, most = slopes[0], slopes[0]
        for slope in slopes[1:]:
            least, most = dr.minimum(least, slope), dr.maximum(most, slope)
        corners = [a * b for a in (least, most) for b in (e, e - view.w)]
        lower += dr.minimum(dr.minimum(corners[0], corners[1]), dr.minimum(corners[2], corners[3]))
        upper += dr.maximum(dr.maximum(corners[0], corners[1]), dr.maximum(corners[2], corners[3]))
    return (lower <= 0) & (upper >= 0)
