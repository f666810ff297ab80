"""What every kind of edge can be asked: the contract behind which meshes, outlines and intersections are alike.

A kind is one family of discontinuities, with rows of its own in the edge table. Estimators ask the table, which asks
each kind about its own rows. Two sorts share how a line through one of their points is drawn:

    FixedKind      a curve in space, the same from everywhere: draw the point first, then a direction
    ContourKind    an outline, elsewhere for every viewpoint: draw the direction, or the viewpoint, first

A new kind is a file with a subclass of one of them, or of `EdgeKind` with a `line` of its own, and an entry in
`scene_table.edge_table`. `line_weights` and `wedges` say what it takes part in: a step inside a surface, say, matters
for `Use.STEP` and casts no shadow. Everything is detached but for `displacement`. `row` counts the kind's own rows;
lanes that are not `active` may hold any row and are ignored.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import ClassVar, Protocol

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, viewpoint
from .film_cover import LENS_CENTRE, outline_cover
from .lights import LightBounds
from .location import EdgeLocation
from .points import past_lift
from .wedges import Wedges


class Use(Enum):
    """What a line through an edge is drawn for: decides in which directions an edge can matter."""

    STEP = "step"  # radiance differs across it: outlines and visible creases, borders, seams
    BACKGROUND = "background"  # what lies behind it appears or disappears: outlines
    SHADOW = "shadow"  # light passes on one side only: outlines


@dataclass
class OnEdge:
    """A point of an edge; detached, one entry per sample."""

    x: mi.Point3f  # [m]
    dx: mi.Vector3f  # derivative of x by the row's parameter t; in general, the length of edge that a sample is [m]
    outward: mi.Vector3f  # of a contour: leads off the surface, across the edge; 0 where neither side is special
    local: mi.Point3f  # of a contour: the material point, in object space
    scale: mi.Float  # of a contour: size of its shape [m]; 0 on fixed edges
    offset: mi.Float  # step to the side at which a ray passes the edge [m]
    lead: mi.Float  # step along a line that clears what the edge belongs to, or rests on [m]
    aside: mi.Float  # step to the side that a line through the point itself needs: 0 unless it is tangent to a surface
    valid: mi.Bool

    def across(self, ω: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
        """Seen along ω: `(n_perp, across)`, the unit vector across the edge, away from the surface of a contour, and
        the length of edge that is seen per unit of its parameter, |dx/dt × ω| [m].
        """
        side = dr.cross(self.dx, ω)
        length = dr.norm(side)
        side = dr.select(length > 0, side / length, 0)
        return side * dr.select(dr.dot(self.outward, side) >= 0, 1.0, -1.0), length


@dataclass
class Sight:
    """An edge point and the line along which it is looked at; detached, one entry per sample."""

    at: EdgeLocation
    ω: mi.Vector3f  # unit, from the viewer to the edge point
    r: mi.Float  # how far away the viewer is [m]
    n_perp: mi.Vector3f  # unit, perpendicular to ω and to the edge
    offset: mi.Float  # as of `OnEdge`
    lead: mi.Float

    @staticmethod
    def of(on: OnEdge, row: mi.UInt32, t: mi.Float, ω: mi.Vector3f, r: mi.Float, n_perp: mi.Vector3f) -> Sight:
        """The point `on` of `row` of the table, looked at from the distance `r`."""
        return Sight(EdgeLocation(row, t, on.x, on.local, on.scale), ω, r, n_perp, on.offset, on.lead)

    @property
    def viewer(self) -> mi.Point3f:
        return self.at.x - self.r * self.ω

    def past_lift(self, which: mi.UInt32) -> mi.Vector3f:
        """From where the ray `beside` starts to where rays that Mitsuba starts beside the edge are clear of the shape:
        see `points.past_lift`.
        """
        offset, lead = past_lift(self.at.x, self.offset, self.lead, self.r)
        return mi.Vector3f(replace(self, offset=offset, lead=lead).beside(which).o - self.beside(which).o)

    def beside(self, which: mi.UInt32) -> mi.Ray3f:
        """The ray that passes the edge on side `which`: 0 towards −n_perp, 1 towards +n_perp."""
        towards = dr.select(which == 0, -1.0, 1.0)
        return mi.Ray3f(self.at.x + towards * self.offset * self.n_perp - self.lead * self.ω, self.ω)


@dataclass
class Side:
    """What lies on one side of an edge: a face of its own, or whatever a ray meets."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    traced: mi.Bool  # `pi` is still to be found by tracing `ray`
    own: mi.Bool  # a surface that moves as the edge does: relative to it, the edge rests
    differs: mi.Bool  # the two sides may differ at all
    aside: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))  # farther off, where others are next to it, ...
    shape: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))  # ... than this one: its registry index

    @staticmethod
    def found_by(ray: mi.Ray3f, own: mi.Bool | bool = False) -> Side:
        """To be found by tracing `ray`."""
        none = dr.zeros(mi.PreliminaryIntersection3f)
        return Side(ray, none, mi.Bool(True), mi.Bool(own), mi.Bool(True))

    @staticmethod
    def of_segment(segments, segment: mi.UInt32, x: mi.Point3f, sight: Sight, which: mi.UInt32, own: mi.Bool) -> Side:
        """The point `x` of a `segment` of curves or bodies (`scene.surfaces`) where `own`; elsewhere found by tracing.

        It is not shot at: what it looks like beside its edge is known better than a ray meets it.
        """
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = own
        pi.t = dr.select(own, sight.r, dr.inf)
        pi.shape, pi.prim_index = segments.pointer(segment, own), segments.prim_index(segment, own)
        beside = sight.beside(which)
        ray = mi.Ray3f(dr.select(own, x - sight.r * sight.ω, beside.o), beside.d)
        return Side(ray, pi, ~own, mi.Bool(own), mi.Bool(True))


@dataclass
class Line:
    """A line through an edge point, in a direction in which the edge can matter; detached, one entry per sample."""

    on: OnEdge
    ω: mi.Vector3f  # unit, from the viewer's side
    pdf_sa: mi.Float  # of ω, per solid angle
    pdf_reversed: mi.Float  # of −ω


class Views(Protocol):
    """How directions through the points of given rows of the table are drawn: where they can matter, as `Wedges` say,
    and where something is to be seen that moves.
    """

    use: Use

    def sample(self, w: Wedges, x: mi.Point3f, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
        """Unit direction through x, from the viewer's side."""

    def pdf(self, w: Wedges, x: mi.Point3f, ω: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Its density per solid angle."""


class EdgeKind(ABC):
    """One family of discontinuities."""

    blocks_light: ClassVar[bool] = True  # do shadow rays notice it at all?
    near_outlines: ClassVar[bool] = False  # may it lie so close to an outline that it must not be taken for one?
    shades_only: ClassVar[bool] = False  # does only what one surface sends step there, not its place or normal?

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of rows."""

    @abstractmethod
    def moving(self) -> mi.Bool:
        """By row: can it move?"""

    @abstractmethod
    def places(self) -> mi.Point3f:
        """By row: roughly where it is [m]."""

    @abstractmethod
    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """By row: how much of it the sensor can see, as a length on the film [px]; 0 only if certainly nothing."""

    @abstractmethod
    def line_weights(self, use: Use) -> mi.Float:
        """By row: length × measure of the directions in which it matters [m rad]; 0 only if there are none."""

    @abstractmethod
    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        """By row: may one of `lights` see it as an outline, with something of the scene (`box`) behind it?"""

    @abstractmethod
    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        """The point at t ∈ [0, 1) of `row` for a viewpoint: homogeneous, (x, y, z, 1) or (−direction, 0)."""

    @abstractmethod
    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        """A line through `row`, from `t` and `u`, all uniform in [0, 1)."""

    @abstractmethod
    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """What lies on side `which` of the edge: 0 towards −n_perp, 1 towards +n_perp."""

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """Where a ray is aimed that asks whether the viewer sees the edge: the point, or a little off it."""
        return sight.at.x

    def body(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """A point of the sheet that ends at the edge, next to it: of an edge that lies on another surface, it tells on
        which side of it. The point that is aimed at where no such question arises.
        """
        return self.aim(row, sight, active)

    def face_along(self, row: mi.UInt32, ω: mi.Vector3f, active: mi.Bool) -> mi.Normal3f:
        """Unit normal of the flat face at the edge that is most nearly in line with ω; 0 where there is none."""
        return mi.Normal3f(0)

    def lies_in(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Normal3f:
        """Unit normal of the flat face on which the edge lies, away from its borders; 0 where there is none."""
        return mi.Normal3f(0)

    @abstractmethod
    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Vector of value 0 whose derivative is the velocity of the edge there, attached, as seen by parallel lines of
        the fixed direction ω (detached). Its part along the edge is arbitrary.
        """

    def turn(
        self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f, active: mi.Bool
    ) -> mi.Vector3f:
        """κ [m]: where the direction ω turns by ω̇, the edge moves by κ·ω̇ along n_perp, in addition.

        0 on curves in space, and on outlines, which slide along their surface.
        """
        return mi.Vector3f(0)


class FixedKind(EdgeKind):
    """A curve in space."""

    @abstractmethod
    def wedges(self, row: mi.UInt32, use: Use, active: mi.Bool) -> Wedges:
        """The directions in which it matters, with their relative densities."""

    @abstractmethod
    def open_side(self, row: mi.UInt32, dx: mi.Vector3f, ω: mi.Vector3f, active: mi.Bool):
        """Where light along ω passes: `(n_perp to the open side, across, whether it is an outline for ω)`."""

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        on = self.on(row, t, mi.Vector4f(0, 0, 0, 1), active)
        w = self.wedges(row, views.use, active)
        ω = views.sample(w, on.x, u, active)
        return Line(on, ω, *(views.pdf(w, on.x, d, active) for d in (ω, -ω)))


class ContourKind(EdgeKind):
    """An outline of a curved surface."""

    @abstractmethod
    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        """A point inside the surface: what a light is asked to shine at before the outline is known."""

    def shades(self, row: mi.UInt32, on: OnEdge, ω: mi.Vector3f, active: mi.Bool) -> mi.Bool | bool:
        """Do rays along ω, towards a light, notice the surface there? Mitsuba shows some surfaces from outside only."""
        return True

    def film_weights(self, frame: SensorFrame, border: int) -> mi.Float:
        """That of the arc through three points of each row."""
        row = dr.arange(mi.UInt32, self.count)
        eye = viewpoint(frame, mi.Point2f(LENS_CENTRE))
        on = [self.on(row, mi.Float(t), eye, mi.Bool(True)) for t in (0.0, 0.5, 1.0)]
        return outline_cover(frame, border, [point.x for point in on])

    def casts_shadow(self, lights: list[LightBounds], box: mi.ScalarBoundingBox3f) -> mi.Bool:
        """Where the outline is depends on the light: nothing is ruled out."""
        return dr.full(mi.Bool, True, self.count)

    def line(self, row: mi.UInt32, t: mi.Float, u: mi.Point2f, views: Views, active: mi.Bool) -> Line:
        """The direction first: parallel lines touch a surface along one contour."""
        ω = mi.warp.square_to_uniform_sphere(u)
        on = self.on(row, t, mi.Vector4f(-ω.x, -ω.y, -ω.z, 0), active)
        return Line(on, ω, mi.Float(dr.inv_four_pi), mi.Float(dr.inv_four_pi))
