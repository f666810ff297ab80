"""Edges of triangle meshes: outlines, creases, borders and seams, straight and fixed in space."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame
from .coinciding import PointsBetween
from .film_cover import EdgeOnFilm, straight_cover
from .joined_meshes import attached_positions
from .kind import FixedKind, OnEdge, Side, Sight, Use
from .lights import LightBounds, may_cast_shadow
from .location import EdgeLocation
from .points import CLEARLY_SEEN, NEARLY_EDGE_ON, clearance, face_sides
from .rows import EdgeRows, face_uv
from .wedges import Wedges, crease_relevance, silhouette_wedges, step_wedges


def straight_point(rows: EdgeRows, row: mi.UInt32, t: mi.Float, active) -> tuple[mi.Point3f, mi.Vector3f]:
    """Point at parameter `t` of straight rows, and its derivative by `t`."""
    p0 = dr.gather(mi.Point3f, rows.p0, row, active)
    dx = mi.Vector3f(dr.gather(mi.Point3f, rows.p1, row, active) - p0)
    return mi.Point3f(p0 + t * dx), dx


def on_fixed(x: mi.Point3f, dx: mi.Vector3f, centre: mi.Point3f, blur: mi.Float, active: mi.Bool) -> OnEdge:
    """A point of an edge whose place does not depend on the viewpoint."""
    offset, lead = clearance(x, dr.norm(dx), centre, blur)
    return OnEdge(
        x, dx, mi.Vector3f(0), mi.Point3f(0), mi.Float(0), offset=offset, lead=lead, aside=mi.Float(0), valid=active
    )


class BetweenFaces(FixedKind):
    """Straight rows between two faces, whatever the faces belong to."""

    rows: EdgeRows

    @property
    def count(self) -> int:
        return dr.width(self.rows.v0)

    def moving(self) -> mi.Bool:
        return self.rows.moves

    def places(self) -> mi.Point3f:
        return (self.rows.p0 + self.rows.p1) / 2

    def normals(self, row: mi.UInt32, active: mi.Bool) -> tuple[mi.Normal3f, mi.Normal3f]:
        """Of both faces at the edges."""
        return dr.gather(mi.Normal3f, self.rows.n0, row, active), dr.gather(mi.Normal3f, self.rows.n1, row, active)


@dataclass(frozen=True)
class MeshEdges(BetweenFaces):
    """Rows of the edge set."""

    meshes: tuple[mi.Mesh, ...]
    rows: EdgeRows
    shapes: mi.ShapePtr  # by EdgeRows.shape0 and shape1
    centre: mi.Point3f  # of the scene
    between: PointsBetween | None = None  # ends of rows that are no vertices

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        seen = EdgeOnFilm.of(self.rows, frame)
        anywhere = self.rows.traced | self.rows.border
        relevance = dr.select(anywhere | seen.may_be_outline, 1, crease_relevance(self.rows))
        return straight_cover(self.rows, frame, border, relevance, seen.behind0 & seen.behind1)

    def line_weights(self, use: Use) -> mi.Float:
        return dr.norm(self.rows.p1 - self.rows.p0) * _wedges(self.rows, use).measure

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return may_cast_shadow(self.rows, lights, box)

    def wedges(self, row: mi.UInt32, use: Use, active: mi.Bool) -> Wedges:
        return _wedges(dr.gather(EdgeRows, self.rows, row, active), use)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        x, dx = straight_point(self.rows, row, t, active)
        return on_fixed(x, dx, self.centre, dr.gather(mi.Float, self.rows.blur, row, active), active)

    def open_side(self, row: mi.UInt32, dx: mi.Vector3f, ω: mi.Vector3f, active: mi.Bool):
        n0, n1 = self.normals(row, active)
        border = dr.gather(mi.Bool, self.rows.border, row, active)
        side = dr.cross(dx, ω)
        across = dr.norm(side)
        side = dr.select(across > 0, side / across, 0)
        # Two edges of a face in line with the light cast one shadow: the one whose other face is lit counts.
        a0, a1 = face_sides(n0, n1, ω)
        silhouette = (across > 0) & dr.select(border, a0 != 0, (a0 < 0) != (a1 > 0))
        where_faces_are = a0 + dr.select(border, 0, a1)
        return side * dr.select(where_faces_are > 0, -1.0, 1.0), across, silhouette

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """Adjacent faces are found by topology, never by shooting at them: a face seen nearly edge-on is narrower than
        any offset. With b_i the direction into face i, face i lies on side sign(b_i · n_perp) (`face_sides`); two faces
        on the same side are a silhouette, of which the one nearer to the viewer is seen. A face seen edge-on is on
        neither side: the other face, if there is one, then ends at a silhouette. What silhouettes hide right behind
        them is looked at clear of where Mitsuba starts rays (`past_lift`).
        """
        rows = dr.gather(EdgeRows, self.rows, row, active)
        τ = dr.normalize(rows.p1 - rows.p0)
        into0, into1 = dr.cross(rows.n0, τ), dr.cross(τ, rows.n1)
        a0, a1 = face_sides(rows.n0, rows.n1, sight.ω)
        in_view = (a0 != 0) | (a1 != 0)
        silhouette = ~rows.border & (a0 * a1 >= 0)
        nearer1 = silhouette & (dr.dot(into1, sight.ω) * dr.abs(a0) < dr.dot(into0, sight.ω) * dr.abs(a1))

        towards = dr.select(which == 0, -1.0, 1.0)
        on0, on1 = a0 * towards > 0, ~rows.border & (a1 * towards > 0)
        use1 = on1 & (~on0 | nearer1)
        face = (on0 | on1) & ~rows.traced
        pi = self._face(rows, use1, sight, face & active)
        beside = sight.beside(which)
        ray = mi.Ray3f(dr.select(face, sight.viewer, beside.o), beside.d)
        aside = dr.select((silhouette | rows.border) & ~rows.traced & ~face, sight.past_lift(which), 0)
        # Borders of two shapes at one place, of which one moves: their faces move against each other.
        own = face & ((rows.shape0 == rows.shape1) | ~rows.moves)
        differs = in_view & (rows.border | silhouette | rows.seam) | rows.traced
        shape = dr.reinterpret_array(mi.UInt32, dr.gather(mi.ShapePtr, self.shapes, rows.shape0, active))
        return Side(ray, pi, ~face, own, differs, aside, shape)

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Onto the other face where one of two is seen edge-on, past both of an outline where one is nearly so; the
        point itself at all other edges.

        A line of sight to such an edge runs along the face, and whether it meets what ends with it is rounding.
        """
        n0, n1 = self.normals(row, active)
        border = dr.gather(mi.Bool, self.rows.border, row, active)
        a0, a1 = face_sides(n0, n1, sight.ω)
        one = ~border & ((a0 == 0) ^ (a1 == 0))
        onto = one & (dr.abs(a0 + a1) > CLEARLY_SEEN)
        past = ~border & (a0 * a1 > 0) & (dr.minimum(dr.abs(a0), dr.abs(a1)) < NEARLY_EDGE_ON)
        towards = dr.select(onto, 1.0, dr.select(one | past, -1.0, 0.0))
        return sight.at.x + towards * dr.sign(a0 + a1) * sight.offset * sight.n_perp

    def body(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """On the face of a border."""
        rows = dr.gather(EdgeRows, self.rows, row, active)
        into = dr.normalize(dr.cross(rows.n0, rows.p1 - rows.p0))
        return dr.select(rows.border & ~rows.traced, sight.at.x + sight.lead * into, self.aim(row, sight, active))

    def face_along(self, row: mi.UInt32, ω: mi.Vector3f, active: mi.Bool) -> mi.Normal3f:
        n0, n1 = self.normals(row, active)
        return dr.select(dr.abs(dr.dot(n0, ω)) < dr.abs(dr.dot(n1, ω)), n0, n1)

    def _face(self, rows: EdgeRows, use1: mi.Bool, sight: Sight, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """A point of face 0 or 1 next to the edge, as if the viewer had looked at it."""
        corners = dr.select(use1, rows.corner1, rows.corner0)
        uv = face_uv(corners, sight.at.t)
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(pi.valid, sight.r, dr.inf)
        pi.prim_index = dr.select(use1, rows.prim1, rows.prim0)
        pi.shape = dr.gather(mi.ShapePtr, self.shapes, dr.select(use1, rows.shape1, rows.shape0), active)
        pi.prim_uv = uv + dr.select(use1, rows.inset1, rows.inset0) * (mi.Point2f(1 / 3) - uv)
        return pi

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        positions = attached_positions(self.meshes)
        if self.between is not None:
            positions = self.between.added_to(positions)
        v0, v1 = (dr.gather(mi.UInt32, v, row, active) for v in (self.rows.v0, self.rows.v1))
        x0, x1 = (dr.gather(mi.Point3f, positions, v, active) for v in (v0, v1))
        x = (1 - at.t) * x0 + at.t * x1
        return mi.Vector3f(x - dr.detach(x))


def _wedges(rows: EdgeRows, use: Use) -> Wedges:
    return step_wedges(rows) if use is Use.STEP else silhouette_wedges(rows)
