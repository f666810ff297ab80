"""From a row of the edge tables to a point seen by the sensor: position, tangent, and the two sides of the edge."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, View, look_at, towards_viewer, viewpoint
from .curves import (
    PIECES,
    CurvePoint,
    CurveSet,
    attached_to_world,
    curve_point,
    curve_scale,
    local_viewpoint,
    transform_point,
    transform_vector,
)
from .junction_points import bend, junction_motion
from .rows import EdgeRows, apex_uv, face_uv
from .segments import EdgeSet, attached_positions

#: Sideways distance at which a ray that passes an edge is traced, relative to the distance from the scene's centre: far
#: below anything one can see.
SIDE_OFFSET = 1e-5

#: What is added for the rounding of float32 positions, relative to the coordinates: eight units in the last place.
ROUNDING = 1e-6

#: The side rays start this many side offsets in front of the edge: an edge that rests on another surface is then
#: seen against that surface, and the ray does not start beneath it.
LEAD = 100.0

#: The same for what rounding adds: far from the origin, a hundredfold is no small distance.
ROUNDING_LEAD = 10.0

#: The same for curved surfaces, as a fraction of the curve's own scale: a ray just inside a tangent point must start
#: outside the bulge of the surface, which is sqrt(2 · SIDE_OFFSET) deep.
CURVE_LEAD = 0.02

#: Share of the way from the edge to its face's centroid (beyond a dark fringe: to its apex) at which the face's own
#: radiance is taken. On the edge itself rounding may put the point inside a surface on which the edge rests, and
#: everything it sees would be occluded.
INSET = 3e-4

#: Share of the distance to the edge that the visibility ray leaves out.
VISIBILITY_EPSILON = 1e-4


@dataclass
class EdgePoint:
    """A point on an edge as the sensor sees it through one lens point; detached, one entry per sample."""

    x: mi.Point3f  # [m]
    view: View
    side: mi.Vector3f  # unit, perpendicular to ω and to the edge: across the edge
    speed: mi.Float  # length of edge seen per unit of its parameter, |dx/ds × ω| [m]
    valid: mi.Bool


@dataclass
class Side:
    """What lies on one side of an edge: a face of its own, or whatever the ray meets."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    traced: mi.Bool  # `pi` is still to be found by tracing `ray`


def _across(dx: mi.Vector3f, ω: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
    side = dr.cross(dx, ω)
    length = dr.norm(side)
    return dr.select(length > 0, side / length, 0), length


def segment_position(edges: EdgeSet, row, t, active) -> tuple[mi.Point3f, mi.Vector3f]:
    """Point at parameter `t` of an edge or of an intersection curve, and its derivative by `t`."""
    p0 = dr.gather(mi.Point3f, edges.rows.p0, row, active)
    dx = mi.Vector3f(dr.gather(mi.Point3f, edges.rows.p1, row, active) - p0)
    x = mi.Point3f(p0 + t * dx)
    if edges.junctions is None:
        return x, dx
    return bend(edges.junctions, dr.gather(mi.UInt32, edges.rows.junction, row, active), x, dx, active)


def segment_point(edges: EdgeSet, row, t, frame: SensorFrame, aperture: mi.Point2f, active) -> EdgePoint:
    """Point at parameter `t` of a straight edge."""
    x, dx = segment_position(edges, row, t, active)
    view = look_at(frame, x, aperture)
    side, speed = _across(dx, view.ω)
    return EdgePoint(x, view, side, speed, active & view.valid & (speed > 0))


def segment_motion(edges: EdgeSet, row, t, active) -> mi.Vector3f:
    """Vector of value 0 that moves with the same point: attached to the vertices of its mesh, or to both surfaces."""
    positions = attached_positions(edges.meshes)
    v0, v1 = (dr.gather(mi.UInt32, v, row, active) for v in (edges.rows.v0, edges.rows.v1))
    x = (1 - t) * dr.gather(mi.Point3f, positions, v0, active) + t * dr.gather(mi.Point3f, positions, v1, active)
    motion = mi.Vector3f(x - dr.detach(x))
    if edges.junctions is None:
        return motion
    index = dr.gather(mi.UInt32, edges.rows.junction, row, active)
    at_junction = active & (index > 0)
    place, _ = segment_position(edges, row, t, at_junction)
    return dr.select(at_junction, junction_motion(edges.junctions, index, t, dr.detach(place), at_junction), motion)


def clearance(x: mi.Point3f, size: mi.Float, centre: mi.Point3f, blur: mi.Float | float = 0.0):
    """Steps off an edge at `x` [m]: `(sideways, along the line, clear of what the edge rests on)`.

    `size`: of the edge or its shape; `centre`: of the scene, so that its place in space matters by rounding only;
    `blur`: of the faces at the edge.
    """
    visible = SIDE_OFFSET * (dr.max(dr.abs(x - centre)) + size)
    rounding = ROUNDING * dr.max(dr.abs(x)) + blur
    return visible + rounding, LEAD * visible + ROUNDING_LEAD * rounding


def segment_sides(
    edges: EdgeSet, centre: mi.Point3f, row, t, point: EdgePoint, which: mi.UInt32, active
) -> tuple[Side, mi.Bool]:
    """One side of a straight edge: `which` = 0 towards −`point.side`, 1 towards +`point.side`.

    Adjacent faces are found by topology, never by shooting at them: a face seen nearly edge-on is narrower than any
    offset. With b_i the direction into face i, face i lies on side sign(b_i · side); two faces on the same side
    are a silhouette, of which the one nearer to the viewer is seen. Also returns whether the two sides can differ.
    """
    rows = dr.gather(type(edges.rows), edges.rows, row, active)
    τ = dr.normalize(rows.p1 - rows.p0)
    ω = point.view.ω
    into0, into1 = dr.cross(rows.n0, τ), dr.cross(τ, rows.n1)
    a0, a1 = dr.dot(into0, point.side), dr.dot(into1, point.side)
    silhouette = ~rows.border & (a0 * a1 > 0)
    nearer1 = silhouette & (dr.dot(into1, ω) * dr.abs(a0) < dr.dot(into0, ω) * dr.abs(a1))

    towards = dr.select(which == 0, -1.0, 1.0)
    on0, on1 = a0 * towards > 0, ~rows.border & (a1 * towards > 0)
    use1 = on1 & (~on0 | nearer1)
    own = (on0 | on1) & ~rows.traced
    corners = dr.select(use1, rows.corner1, rows.corner0)
    uv = face_uv(corners, t)
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.valid = own & active
    pi.t = dr.select(pi.valid, point.view.r, dr.inf)
    pi.prim_index = dr.select(use1, rows.prim1, rows.prim0)
    pi.shape = dr.gather(mi.ShapePtr, edges.shapes, dr.select(use1, rows.shape1, rows.shape0), active & own)
    fringe = _fringe(edges, rows, use1, t, -ω, own & active)
    apex = apex_uv(corners)
    uv += fringe * (apex - uv)
    # Beyond a fringe only the apex is sure to be lit: the way to the centroid may lead back into the dark.
    pi.prim_uv = uv + INSET * (dr.select(fringe > 0, apex, mi.Point2f(1 / 3)) - uv)

    offset, lead = clearance(point.x, dr.norm(rows.p1 - rows.p0), centre, rows.blur)
    beside = point.x + towards * offset * point.side - lead * ω
    ray = mi.Ray3f(dr.select(own, point.view.o, beside), ω)
    return Side(ray, pi, ~own), rows.border | silhouette | rows.seam | rows.traced


def _fringe(edges: EdgeSet, rows: EdgeRows, use1: mi.Bool, t: mi.Float, viewer: mi.Vector3f, active) -> mi.Float:
    """Share of the way from an edge to the opposite corner at which the shading normal begins to face the viewer.

    Along an outline, interpolated normals turn away from the viewer before the surface does, and a BSDF is black
    there. The step at the inner end of this fringe, as thin as the mesh is fine, is counted with the outline.
    """
    if edges.normals is None:
        return mi.Float(0)
    active &= rows.smooth
    apex = dr.select(use1, rows.apex1, rows.apex0)
    viewer *= dr.sign(dr.dot(dr.select(use1, rows.n1, rows.n0), viewer))  # the back of an open surface
    at0, at1, at_apex = (
        dr.dot(dr.gather(mi.Normal3f, edges.normals, v, active), viewer) for v in (rows.v0, rows.v1, apex)
    )
    at_edge = (1 - t) * at0 + t * at1
    return dr.select(active & (at_edge < 0) & (at_apex > 0), at_edge / (at_edge - at_apex), 0)


def contour_side(columns, local: CurvePoint, ω: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """Across a curve seen along ω: `(unit vector away from the shape, |dx/dt × ω|, size of the shape)`; t per piece."""
    side, speed = _across(transform_vector(columns, local.dx_ds) / PIECES, ω)
    outward = transform_vector(columns, local.outward)
    return side * dr.select(dr.dot(outward, side) >= 0, 1.0, -1.0), speed, curve_scale(columns, local)


def curve_row_point(curves: CurveSet, row, t, frame: SensorFrame, aperture: mi.Point2f, active):
    """Point at parameter `t` of a piece of an analytic curve: `(EdgePoint, local point, outward, scale)`."""
    rows = dr.gather(type(curves.rows), curves.rows, row, active)
    columns = tuple(dr.detach(c) for c in attached_to_world(curves.shapes, rows.shape))
    local = curve_point(rows.kind, rows.start + t / PIECES, local_viewpoint(columns, viewpoint(frame, aperture)))
    x = transform_point(columns, local.x)
    view = look_at(frame, x, aperture)
    side, speed, scale = contour_side(columns, local, view.ω)
    valid = active & view.valid & local.valid & (speed > 0)
    return EdgePoint(x, view, side, speed, valid), local.x, scale


def curve_motion(curves: CurveSet, row, local: mi.Point3f, active) -> mi.Point3f:
    """The material point at `local`, attached to its shape's pose: a contour moves with n·v of the surface."""
    shape = dr.gather(mi.UInt32, curves.rows.shape, row, active)
    return transform_point(attached_to_world(curves.shapes, shape), dr.detach(local))


def curve_sides(point: EdgePoint, centre: mi.Point3f, scale: mi.Float, which: mi.UInt32) -> Side:
    """Rays just inside (`which` = 0) and outside (1) of a curve."""
    offset, _ = clearance(point.x, scale, centre)
    towards = dr.select(which == 0, -1.0, 1.0)
    ray = mi.Ray3f(point.x + towards * offset * point.side - CURVE_LEAD * scale * point.view.ω, point.view.ω)
    return Side(ray, dr.zeros(mi.PreliminaryIntersection3f), mi.Bool(True))


def facing(n: mi.Normal3f, x: mi.Point3f, view: mi.Vector4f) -> mi.Float:
    """> 0 where a face with normal `n` through `x` turns to the viewpoint (not normalised)."""
    return dr.dot(n, towards_viewer(view, x))
