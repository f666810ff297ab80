"""Steps inside surfaces: the lines of checkerboards and the texel borders of nearest-neighbour bitmaps.

Both sides of such a line are the same surface, fixed in texture coordinates: its motion is that of the material, it
casts no shadow, and hides nothing. Only what slides over it makes a derivative: the sensor's ray, and in the spatial
form the points of a path. Rows are up to `BLOCK` neighbouring lines on a small patch (`pattern_rows.py`): t picks one
of them, and a point of its piece on the patch,

    j = ⌊t N⌋,        q(t) = q_a + (t N − j)(q_b − q_a),        dx/dt = N ∂x/∂q (q_b − q_a)

with q_a, q_b where line j enters and leaves the patch, in the surface's own coordinates q.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, look_at, towards_viewer, viewpoint
from ..scene.poses import Poses
from .curves import transform_point
from .film_cover import LENS_CENTRE, PatchOnFilm, beside_film
from .joined_meshes import attached_positions
from .kind import FixedKind, OnEdge, Side, Sight, Use
from .lights import LightBounds
from .location import EdgeLocation
from .pattern_rows import PatternRows, PatternSet
from .points import clearance, facing
from .surface_points import SurfacePoint, point_of_body, point_of_face, surface_point
from .wedges import Wedges

#: Sine of the angle at which all corners of a patch of a sphere turn away if all of the patch does.
FAR_SIDE = 0.25


@dataclass
class LinePiece:
    """A line on a patch, in the surface's coordinates. Detached."""

    a: mi.Point2f  # where it enters the patch
    along: mi.Vector2f  # from there to where it leaves
    at: mi.Float  # share of the way
    inset: mi.Float  # how far beside it its sides are, in texture coordinates

    @property
    def q(self) -> mi.Point2f:
        return self.a + self.at * self.along


def piece_of_line(lines: PatternSet, rows: PatternRows, number: mi.UInt32, at: mi.Float, active) -> LinePiece:
    """Line `number` of `rows`, counted from the first of each, at the share `at` of its way across the patch."""
    index = rows.line + dr.minimum(number, rows.count - 1)
    s = dr.gather(mi.Float, lines.s, index, active)

    def share(low, high):
        return dr.clip(dr.select(high > low, (s - low) / (high - low), 0), 0, 1)

    a = rows.q0 + share(rows.s0, rows.s2) * (rows.q2 - rows.q0)
    below = rows.q0 + share(rows.s0, rows.s1) * (rows.q1 - rows.q0)
    above = rows.q1 + share(rows.s1, rows.s2) * (rows.q2 - rows.q1)
    along = mi.Vector2f(dr.select(s < rows.s1, below, above) - a)
    return LinePiece(mi.Point2f(a), along, at, dr.gather(mi.Float, lines.inset, index, active))


@dataclass(frozen=True)
class PatternLines(FixedKind):
    """Rows of a `PatternSet`; subclasses know the surface."""

    blocks_light: ClassVar[bool] = False
    shades_only: ClassVar[bool] = True

    lines: PatternSet
    moves: mi.Bool  # by row
    front: mi.Float  # by row: may it be seen from the side of its normals (`_normal`)? 0 or 1
    back: mi.Float  # by row: and from the other one?
    pointers: mi.ShapePtr  # by PatternRows.shape
    centre: mi.Point3f  # of the scene
    shapes: tuple[mi.Shape, ...]

    @abstractmethod
    def _point(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        """The point with the coordinates `q` on the shapes of `rows`."""

    @abstractmethod
    def _attached(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> mi.Point3f:
        """The same, attached to the motion of the shape."""

    @property
    def count(self) -> int:
        return dr.width(self.lines.rows.line)

    def moving(self) -> mi.Bool:
        return self.moves

    def places(self) -> mi.Point3f:
        rows = self.lines.rows
        return self._point(rows, (rows.q0 + rows.q1 + rows.q2) / 3, mi.Bool(True)).x

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        return dr.full(mi.Bool, False, self.count)

    def open_side(self, row: mi.UInt32, dx: mi.Vector3f, ω: mi.Vector3f, active: mi.Bool):
        side = dr.cross(dx, ω)
        across = dr.norm(side)
        return dr.select(across > 0, side / across, 0), across, mi.Bool(False)

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """Lines of the row, times the length on the film of three of them."""
        rows, lens = self.lines.rows, mi.Point2f(LENS_CENTRE)
        corners = [self._point(rows, q, mi.Bool(True)).x for q in (rows.q0, rows.q1, rows.q2)]
        patch = PatchOnFilm.of(corners, frame)
        # a curved patch bulges beyond its corners by less than a quarter of its size
        margin = dr.norm(patch.upper - patch.lower) / 4 + patch.reach
        length = patch.cover(frame, border, self._mean_length(lambda x: look_at(frame, x, lens).p), margin)
        return dr.select(self._unseen(frame, corners, border), 0, mi.Float(rows.count) * length)

    def _unseen(self, frame: SensorFrame, corners: list[mi.Point3f], border: int) -> mi.Bool:
        """By row: certainly beside the film, or turned away, for every point of the lens."""
        return mi.Bool(False)

    def line_weights(self, use: Use) -> mi.Float:
        if use is not Use.STEP:
            return dr.zeros(mi.Float, self.count)
        length = mi.Float(self.lines.rows.count) * self._mean_length(lambda x: x)
        return length * (self.front + self.back) * dr.pi

    def _mean_length(self, seen) -> mi.Float:
        """Of the first, the middle and the last line of every row: length of its chord, as `seen`."""
        rows, total = self.lines.rows, mi.Float(0)
        for number in (mi.UInt32(0), rows.count // 2, rows.count - 1):
            piece = piece_of_line(self.lines, rows, number, mi.Float(0), mi.Bool(True))
            ends = (seen(self._point(rows, q, mi.Bool(True)).x) for q in (piece.a, piece.a + piece.along))
            a, b = ends
            total += dr.norm(b - a)
        return total / 3

    def _located(self, row: mi.UInt32, t: mi.Float, active: mi.Bool) -> tuple[PatternRows, LinePiece]:
        rows = dr.gather(PatternRows, self.lines.rows, row, active)
        x = t * mi.Float(rows.count)
        number = mi.UInt32(dr.floor(x))
        return rows, piece_of_line(self.lines, rows, number, x - dr.floor(x), active)

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        rows, piece = self._located(row, t, active)
        point = self._point(rows, piece.q, active)
        chord = point.towards(piece.along)
        offset, lead = clearance(point.x, dr.norm(chord), self.centre)
        dx = mi.Float(rows.count) * chord
        return OnEdge(
            point.x, dx, mi.Vector3f(0), mi.Point3f(0), mi.Float(0), offset, lead, mi.Float(0), valid=active
        )  # fmt: skip

    def wedges(self, row: mi.UInt32, use: Use, active: mi.Bool) -> Wedges:
        rows = dr.gather(PatternRows, self.lines.rows, row, active)
        point = self._point(rows, rows.q0, active)
        n = dr.normalize(dr.cross(point.dx_dq0, point.dx_dq1))
        across = point.towards(rows.step)
        τ = dr.normalize(dr.cross(n, across))
        front, back = (dr.gather(mi.Float, side, row, active) for side in (self.front, self.back))
        return Wedges(τ, n, mi.Float(0), mi.Float(0), mi.Float(0), front, mi.Float(0), back)

    def _beside(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool):
        """`(rows, q)` a little off the line, on the surface, towards side `which`."""
        rows, piece = self._located(row, sight.at.t, active)
        q = piece.q
        up = dr.dot(self._point(rows, q, active).towards(rows.step), sight.n_perp) > 0
        return rows, q + dr.select(up == (which == 1), 1.0, -1.0) * piece.inset * rows.step

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        rows, piece = self._located(row, at.t, active)
        x = self._attached(rows, dr.detach(piece.q), active)
        return mi.Vector3f(x - dr.detach(x))


@dataclass(frozen=True)
class MeshPatterns(PatternLines):
    """On faces of meshes; q are barycentric coordinates (b1, b2), as Mitsuba's `prim_uv`."""

    positions: mi.Point3f  # of all vertices, detached

    def _point(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        return point_of_face(self.positions, rows, q, active)

    def _attached(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> mi.Point3f:
        return point_of_face(attached_positions(self.shapes), rows, q, active).x

    def _unseen(self, frame: SensorFrame, corners: list[mi.Point3f], border: int) -> mi.Bool:
        view = towards_viewer(viewpoint(frame, mi.Point2f(LENS_CENTRE)), corners[0])
        cos = facing(_normal(self.positions, self.lines.rows, mi.Bool(True)), view)
        slack = frame.aperture if frame.kind == "thinlens" else 0.0  # how far the viewpoint may be from the centre
        away = ((self.front == 0) | (cos <= -slack)) & ((self.back == 0) | (cos >= slack))
        return away | beside_film(frame, corners, border)

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The same face, as if the viewer had looked at it: nothing is traced."""
        rows, q = self._beside(row, sight, which, active)
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = active
        pi.t = dr.select(active, sight.r, dr.inf)
        pi.prim_index, pi.prim_uv = rows.part, q
        pi.shape = dr.gather(mi.ShapePtr, self.pointers, rows.shape, active)
        return Side(mi.Ray3f(sight.viewer, sight.ω), pi, mi.Bool(False), mi.Bool(True), mi.Bool(True))

    def lies_in(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Normal3f:
        return _normal(self.positions, dr.gather(PatternRows, self.lines.rows, row, active), active)


def _normal(positions: mi.Point3f, rows: PatternRows, active) -> mi.Normal3f:
    """Unit normal of the rows' faces."""
    return point_of_face(positions, rows, rows.q0, active).normal


@dataclass(frozen=True)
class AnalyticPatterns(PatternLines):
    """On disks, cylinders and spheres; q are the texture coordinates.

    Normals differ along a row: lines are drawn in all directions, `front` and `back` are 1.
    """

    closed: mi.Bool  # by row: a sphere whose inside is never seen

    @cached_property
    def poses(self) -> Poses:
        return Poses.of(self.shapes)

    def _point(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        return point_of_body(self.poses, rows, q)

    def _attached(self, rows: PatternRows, q: mi.Point2f, active: mi.Bool) -> mi.Point3f:
        return transform_point(self.poses.attached_at(rows.shape), surface_point(rows.part, q)[0])

    def _unseen(self, frame: SensorFrame, corners: list[mi.Point3f], border: int) -> mi.Bool:
        """The far side of a sphere of which the inside is never seen."""
        rows, eye = self.lines.rows, viewpoint(frame, mi.Point2f(LENS_CENTRE))
        centre = mi.Point3f(self.poses.at(rows.shape)[3])
        away = mi.Bool(self.closed)
        for x in corners:
            n, view = dr.normalize(x - centre), towards_viewer(eye, x)
            slack = frame.aperture if frame.kind == "thinlens" else 0.0
            away &= dr.dot(n, view) < -FAR_SIDE * dr.norm(view) - slack
        return away

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """Found by a ray that is aimed a little off the line."""
        rows, q = self._beside(row, sight, which, active)
        ray = mi.Ray3f(self._point(rows, q, active).x - sight.lead * sight.ω, sight.ω)
        return Side.found_by(ray, own=True)
