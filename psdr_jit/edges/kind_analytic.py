"""Outlines and rims of disks, cylinders and spheres, which have no triangles (`curves`)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame
from .curves import (
    PIECES,
    CurveRows,
    CurveSet,
    curve_centre,
    curve_lengths,
    curve_point,
    curve_scale,
    is_rim,
    local_viewpoint,
    own_surface,
    transform_point,
    transform_vector,
)
from .kind import ContourKind, OnEdge, Side, Sight, Use
from .location import EdgeLocation
from .points import INSET, VISIBILITY_EPSILON, clearance


@dataclass(frozen=True)
class AnalyticCurves(ContourKind):
    """Pieces of curves, in proportion to which they are sampled."""

    curves: CurveSet
    moves: mi.Bool  # by row: can its shape move?
    closed: mi.Bool  # by row: is it a rim that a disk closes? What lies beside it is traced
    closing: mi.Bool  # by row: the rim of such a disk, which is left out
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.curves.rows.kind)

    def moving(self) -> mi.Bool:
        return self.moves

    def places(self) -> mi.Point3f:
        return mi.Point3f(self.curves.poses.at(self.curves.rows.shape)[3])

    def line_weights(self, use: Use) -> mi.Float:
        return dr.select(self.closing, 0, curve_lengths(self.curves) * dr.pi)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        return dr.select(self.closing, 0, super().film_weights(frame, border))

    def _columns(self, row: mi.UInt32, active: mi.Bool) -> tuple[CurveRows, tuple[mi.Vector3f, ...]]:
        """The rows, and the columns of their shapes' object-to-world maps, detached."""
        rows = dr.gather(CurveRows, self.curves.rows, row, active)
        return rows, self.curves.poses.at(rows.shape)

    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        rows, columns = self._columns(row, active)
        return transform_point(columns, curve_centre(rows.kind))

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, columns = self._columns(row, active)
        point = curve_point(rows.kind, rows.start + t / PIECES, local_viewpoint(columns, view))
        x, scale = transform_point(columns, point.x), curve_scale(columns, point)
        offset, lead = clearance(x, scale, self.centre)
        return OnEdge(
            x=x,
            dx=transform_vector(columns, point.dx_ds) / PIECES,
            outward=transform_vector(columns, point.outward),
            local=point.x,
            scale=scale,
            offset=offset,
            lead=lead,
            aside=offset,
            valid=active & point.valid,
        )

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """A ray aimed at a tangent point meets the shape itself: beside it. At a rim it does not, and beside the foot
        of a tube there may be a floor.
        """
        rim = is_rim(dr.gather(mi.UInt32, self.curves.rows.kind, row, active))
        return sight.at.x + dr.select(rim, 0, VISIBILITY_EPSILON * sight.at.scale) * sight.n_perp

    def body(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """On the sheet that ends at a rim."""
        rows, columns = self._columns(row, active)
        rim = is_rim(rows.kind) & ~dr.gather(mi.Bool, self.closed, row, active)
        local = own_surface(rows.kind, sight.at.local, mi.Vector3f(0), mi.Float(0), mi.Float(INSET))
        return dr.select(rim, transform_point(columns, local), self.aim(row, sight, active))

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The shape itself on the side −n_perp, and whatever a ray meets on the other.

        The shape is never shot at: a ray that passes an outline on its inner side touches the surface, and unless it
        starts well outside of the bulge it meets the far wall instead.
        """
        own = (which == 0) & ~dr.gather(mi.Bool, self.closed, row, active)
        rows, columns = self._columns(row, active)
        at = sight.at
        ω = local_viewpoint(columns, mi.Vector4f(sight.ω.x, sight.ω.y, sight.ω.z, 0))
        turn = dr.sqrt(2 * sight.offset / at.scale)  # where a ray that passes at the offset would meet it
        local = own_surface(rows.kind, at.local, mi.Vector3f(ω.x, ω.y, ω.z), turn, mi.Float(INSET))
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = own & active
        pi.t = dr.select(pi.valid, sight.r, dr.inf)
        pi.shape = dr.gather(mi.ShapePtr, self.curves.pointers, rows.shape, pi.valid)
        pi.prim_uv = mi.Point2f(local.x, local.y)  # of a disk; the others ask for the point alone
        beside = sight.beside(which)
        ray = mi.Ray3f(dr.select(own, transform_point(columns, local) - sight.r * sight.ω, beside.o), beside.d)
        return Side(ray, pi, ~own, own, mi.Bool(True), dr.select(own, 0, sight.past_lift(which)))

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of the material point: a contour moves with n·v of the surface."""
        shape = dr.gather(mi.UInt32, self.curves.rows.shape, row, active)
        x = transform_point(self.curves.poses.attached_at(shape), dr.detach(at.local))
        return mi.Vector3f(x - dr.detach(x))
