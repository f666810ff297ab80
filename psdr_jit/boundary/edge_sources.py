"""An edge point and an emitter sample on one line: what the direct boundary term starts from."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..analytic_edges import (
    PIECES,
    CurveRows,
    attached_to_world,
    curve_centre,
    curve_point,
    local_viewpoint,
    transform_point,
    transform_vector,
)
from ..edge_set import EdgeRows
from .edge_points import CURVE_LEAD, LEAD, SIDE_OFFSET
from .edges import EdgeTable


@dataclass
class EdgeAndSource:
    """An edge point, the emitter sample seen from it, and which side is open. Detached."""

    x: mi.Point3f
    local: mi.Point3f
    across: mi.Float  # |dx/dt × ω|
    n: mi.Vector3f  # n_⊥
    ω: mi.Vector3f
    dist: mi.Float  # to the emitter point
    value: mi.Spectrum  # L_e / pdf, pdf per solid angle at x
    offset: mi.Float  # sideways step off the edge
    lead: mi.Float  # step along the line that clears the edge's own surface
    valid: mi.Bool


def source_from_segment(scene, table: EdgeTable, row, t, it, u, active) -> tuple[EdgeAndSource, mi.DirectionSample3f]:
    """The emitter is sampled from the edge point; the edge must be a silhouette for that direction."""
    e = dr.gather(EdgeRows, table.segments.rows, row, active)
    dx = mi.Vector3f(e.p1 - e.p0)
    length = dr.norm(dx)
    it.p = e.p0 + t * dx
    ds, value = scene.sample_emitter_direction(it, u, False, active)
    side = dr.cross(dx, ds.d)
    across = dr.norm(side)
    side = dr.select(across > 0, side / across, 0)
    a0, a1 = dr.dot(dr.cross(e.n0, dx), side), dr.dot(dr.cross(dx, e.n1), side)
    silhouette = (across > 0) & (a0 != 0) & (e.border | (a0 * a1 > 0))
    offset = SIDE_OFFSET * (dr.max(dr.abs(it.p)) + length)
    n = side * dr.select(a0 > 0, -1.0, 1.0)
    out = EdgeAndSource(
        it.p, mi.Point3f(0), across, n, ds.d, ds.dist, value, offset, LEAD * offset, active & silhouette
    )
    return out, ds


def source_from_curve(scene, table: EdgeTable, row, t, it, u, active) -> tuple[EdgeAndSource, mi.DirectionSample3f]:
    """A contour depends on where it is seen from: the emitter is sampled from the shape's centre first.

    The density then is per solid angle at the centre; carried over to the contour point by dω = cosθ dA / r².
    """
    rows = dr.gather(CurveRows, table.curves.rows, row - table.segment_count, active)
    columns = tuple(dr.detach(c) for c in attached_to_world(table.curves.shapes, rows.shape))
    centre = transform_point(columns, curve_centre(rows.kind))
    it.p = centre
    ds, value = scene.sample_emitter_direction(it, u, False, active)
    infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    eye = dr.select(infinite, ds.d, mi.Vector3f(ds.p))
    view = mi.Vector4f(eye.x, eye.y, eye.z, dr.select(infinite, 0.0, 1.0))
    local = curve_point(rows.kind, rows.start + t / PIECES, local_viewpoint(columns, view))
    x = transform_point(columns, local.x)
    to_source = dr.select(infinite, ds.d, mi.Vector3f(ds.p - x))
    dist = dr.select(infinite, ds.dist, dr.norm(to_source))
    ω = dr.select(infinite, ds.d, to_source / dist)

    it.p = x
    density = dr.dot(ds.n, ω) * dr.square(ds.dist) / (dr.dot(ds.n, ds.d) * dr.square(dist))
    _, value_delta = ds.emitter.sample_direction(it, u, active & ds.delta)
    value = dr.select(ds.delta, value_delta / ds.pdf, value * dr.select(infinite, 1, dr.maximum(density, 0)))

    outward = transform_vector(columns, local.outward)
    scale = dr.norm(outward)
    side = dr.cross(transform_vector(columns, local.dx_ds) / PIECES, ω)
    across = dr.norm(side)
    side = dr.select(across > 0, side / across, 0)
    n = side * dr.select(dr.dot(outward, side) >= 0, 1.0, -1.0)
    offset = SIDE_OFFSET * (dr.max(dr.abs(x)) + scale)
    valid = active & local.valid & (across > 0)
    return EdgeAndSource(x, local.x, across, n, ω, dist, value, offset, CURVE_LEAD * scale, valid), ds
