"""An edge point and an emitter sample on one line: what the direct boundary term starts from."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edges.curves import (
    PIECES,
    CurveRows,
    attached_to_world,
    curve_centre,
    curve_point,
    local_viewpoint,
    transform_point,
)
from ..edges.points import CURVE_LEAD, clearance, contour_side
from ..edges.rows import EdgeRows
from ..sampling.directions import silhouette_wedges
from ..sampling.relevance import SecondaryEdges

#: Share of the samples under a sky whose direction follows the edge instead of the emitter.
EDGE_SHARE = 0.75


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


def source_from_segment(
    scene, edges: SecondaryEdges, row, t, it, u, active
) -> tuple[EdgeAndSource, mi.DirectionSample3f]:
    """The emitter is sampled from the edge point; the edge must be a silhouette for that direction.

    Under a sky, `EDGE_SHARE` of the samples take a direction in which the edge is a silhouette (`_from_edge_or_sky`).
    """
    e = dr.gather(EdgeRows, edges.table.segments.rows, row, active)
    dx = mi.Vector3f(e.p1 - e.p0)
    length = dr.norm(dx)
    it.p = e.p0 + t * dx
    if scene.environment() is None:
        ds, value = scene.sample_emitter_direction(it, u, False, active)
    else:
        ds, value = _from_edge_or_sky(scene, edges, e, row, it, u, active)
    n, across, silhouette = _open_side(e, dx, ds.d)
    offset, lead = clearance(it.p, length, edges.table.centre, e.blur)
    out = EdgeAndSource(it.p, mi.Point3f(0), across, n, ds.d, ds.dist, value, offset, lead, active & silhouette)
    return out, ds


def _open_side(e: EdgeRows, dx: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Where light along `d` passes a straight edge: `(n_⊥, |dx × d|, whether the edge is a silhouette)`."""
    side = dr.cross(dx, d)
    across = dr.norm(side)
    side = dr.select(across > 0, side / across, 0)
    a0, a1 = dr.dot(dr.cross(e.n0, dx), side), dr.dot(dr.cross(dx, e.n1), side)
    silhouette = (across > 0) & (a0 != 0) & (e.border | (a0 * a1 > 0))
    return side * dr.select(a0 > 0, -1.0, 1.0), across, silhouette


def _from_edge_or_sky(scene, edges: SecondaryEdges, e: EdgeRows, row, it, u, active):
    """Emitter sampling and directions that suit the edge: `(ds, L_e / pdf)`.

    A sky is seen in every direction, so the edge's own density serves as well as the emitter's: balance heuristic of
    both for samples of the sky [Veach 1997, §9.2.2]. Other emitters are left to emitter sampling. A line that leads
    from the sky to a receiver does so in one of its two directions: the one that escapes is taken, whichever was
    drawn, with the sum of both densities.
    """
    sky = scene.environment()
    by_edge = u.x < EDGE_SHARE
    u = mi.Point2f(dr.select(by_edge, u.x / EDGE_SHARE, (u.x - EDGE_SHARE) / (1 - EDGE_SHARE)), u.y)
    ds, value = scene.sample_emitter_direction(it, u, False, active & ~by_edge)

    w = silhouette_wedges(e)
    ω = edges.sample_view(e, w, row, it.p, u, active)
    dx = mi.Vector3f(e.p1 - e.p0)
    n, _, silhouette = _open_side(e, dx, ω)
    offset, lead = clearance(it.p, dr.norm(dx), edges.table.centre, e.blur)
    probe = mi.Ray3f(it.p + offset * n + lead * ω, ω, 0, it.wavelengths)
    ω = dr.select(scene.ray_test(probe, active & by_edge & silhouette), -ω, ω)
    free = dr.zeros(mi.DirectionSample3f, dr.width(ω))
    free.d, free.dist = ω, dr.opaque(mi.Float, 2 * scene.bbox().bounding_sphere().radius)
    free.p = it.p + free.dist * ω
    free.emitter = dr.select(by_edge, mi.EmitterPtr(sky), ds.emitter)
    ds = dr.select(by_edge, free, ds)

    from_sky = active & (ds.emitter == mi.EmitterPtr(sky))
    pdf_em = scene.pdf_emitter_direction(it, ds, from_sky)
    pdf_edge = sum(edges.pdf_view(e, w, row, it.p, d, active) for d in (ds.d, -ds.d))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -ds.d
    si.wavelengths = it.wavelengths
    L = sky.eval(si, from_sky)
    pdf = EDGE_SHARE * pdf_edge + (1 - EDGE_SHARE) * pdf_em
    ds.pdf = dr.select(from_sky, pdf, (1 - EDGE_SHARE) * ds.pdf)
    value = dr.select(from_sky, dr.select(pdf > 0, L / pdf, 0), value / (1 - EDGE_SHARE))
    return ds, value


def source_from_curve(
    scene, edges: SecondaryEdges, row, t, it, u, active
) -> tuple[EdgeAndSource, mi.DirectionSample3f]:
    """A contour depends on where it is seen from: the emitter is sampled without regard to where it shines.

    Points of area lights are drawn by area and weighed by dω = cosθ dA / r² once the contour point is known.
    """
    table = edges.table
    rows = dr.gather(CurveRows, table.curves.rows, row - table.segment_count, active)
    columns = tuple(dr.detach(c) for c in attached_to_world(table.curves.shapes, rows.shape))
    index, inv_pmf, reused = scene.sample_emitter(u.x, active)
    u = mi.Point2f(reused, u.y)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
    on_surface = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    elsewhere = active & ~on_surface
    ps, inv_pdf_area = emitter.sample_position(0, u, on_surface)
    it.p = transform_point(columns, curve_centre(rows.kind))
    ds, _ = emitter.sample_direction(it, u, elsewhere)
    infinite = elsewhere & mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
    eye = dr.select(infinite, ds.d, mi.Vector3f(dr.select(on_surface, ps.p, ds.p)))
    view = mi.Vector4f(eye.x, eye.y, eye.z, dr.select(infinite, 0.0, 1.0))
    local = curve_point(rows.kind, rows.start + t / PIECES, local_viewpoint(columns, view))
    x = transform_point(columns, local.x)
    dist = dr.select(infinite, ds.dist, dr.norm(eye - x))
    ω = dr.select(infinite, ds.d, mi.Vector3f(eye - x) / dist)

    it.p = x
    _, value = emitter.sample_direction(it, u, elsewhere)  # a lamp's falloff is that towards x
    si = mi.SurfaceInteraction3f(ps, it.wavelengths)
    si.wi = si.to_local(-ω)
    cos_θ = dr.maximum(-dr.dot(ps.n, ω), 0)
    by_area = emitter.eval(si, on_surface) * inv_pdf_area * cos_θ / dr.square(dist)
    value = dr.select(on_surface, by_area, value) * inv_pmf
    ds.p = dr.select(on_surface, ps.p, ds.p)
    ds.pdf = dr.select(on_surface, ps.pdf, ds.pdf)
    ds.emitter = emitter

    n, across, scale = contour_side(columns, local, ω)
    offset, _ = clearance(x, scale, table.centre)
    valid = active & local.valid & (across > 0)
    return EdgeAndSource(x, local.x, across, n, ω, dist, value, offset, CURVE_LEAD * scale, valid), ds
