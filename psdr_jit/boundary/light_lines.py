"""Lines through an edge point and a point of a light: what the direct boundary term starts from."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from ..edges.kind import ContourKind, FixedKind, OnEdge, Views
from ..sampling.relevance import SecondaryEdges

#: Share of the samples under a sky whose direction follows the edge instead of the emitter.
EDGE_SHARE = 0.75


@dataclass
class LightLine:
    """An edge point, the emitter sample on a line with it, and which side is open. Detached."""

    on: OnEdge
    n_perp: mi.Vector3f  # to the open side
    across: mi.Float  # |dx/dt × ω| [m]
    ω: mi.Vector3f  # unit, towards the light
    dist: mi.Float  # to the emitter point [m]
    emitter: mi.EmitterPtr
    value: mi.Spectrum  # L_e in the measure of `pdf`; of a delta light, its radiant exposure at x
    pdf: mi.Float  # per solid angle at x, or as the light's own point was drawn (then `value` has dω per that measure)
    valid: mi.Bool


def sample_light_lines(
    scene: mi.Scene, edges: SecondaryEdges, row: mi.UInt32, t: mi.Float, wavelengths, u: mi.Point2f
) -> LightLine:
    """One line for each point (row, t) of the edge table."""
    views = edges.views(row)

    def draw(kind, own_row: mi.UInt32, active: mi.Bool) -> LightLine:
        it = dr.zeros(mi.Interaction3f, dr.width(row))
        it.wavelengths = wavelengths
        if isinstance(kind, FixedKind):
            on = kind.on(own_row, t, mi.Vector4f(0, 0, 0, 1), active)
            return _from_fixed(scene, views, kind, own_row, on, it, u)
        return _from_contour(scene, kind, own_row, t, it, u, active)

    return edges.table.ask(row, draw, among=lambda kind: kind.blocks_light)


def _from_fixed(
    scene: mi.Scene, views: Views, kind: FixedKind, row: mi.UInt32, on: OnEdge, it, u: mi.Point2f
) -> LightLine:
    """The emitter is sampled from the edge point; the edge must be an outline for that direction.

    `row`: of the kind. Under a sky, `EDGE_SHARE` of the samples take a direction in which the edge
    is an outline (`_from_edge_or_sky`).
    """
    it.p = on.x
    if scene.environment() is None:
        ds, weight = scene.sample_emitter_direction(it, u, False, on.valid)
        value, pdf = weight * ds.pdf, ds.pdf
    else:
        ds, value, pdf = _from_edge_or_sky(scene, views, kind, row, on, it, u)
    n_perp, across, outline = kind.open_side(row, on.dx, ds.d, on.valid)
    return LightLine(on, n_perp, across, ds.d, ds.dist, ds.emitter, value, pdf, on.valid & outline)


def _from_edge_or_sky(
    scene: mi.Scene, views: Views, kind: FixedKind, row: mi.UInt32, on: OnEdge, it, u: mi.Point2f
) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.Float]:
    """Emitter sampling and directions that suit the edge: `(ds, L_e, pdf)`.

    A sky is seen in every direction, so the edge's own density serves as well as the emitter's: balance heuristic of
    both for samples of the sky [Veach 1997, §9.2.2]. Other emitters are left to emitter sampling. A line that leads
    from the sky to a receiver does so in one of its two directions: the one that escapes is taken, whichever was
    drawn, with the sum of both densities.
    """
    sky, active = scene.environment(), on.valid
    by_edge = u.x < EDGE_SHARE
    u = mi.Point2f(dr.select(by_edge, u.x / EDGE_SHARE, (u.x - EDGE_SHARE) / (1 - EDGE_SHARE)), u.y)
    ds, weight = scene.sample_emitter_direction(it, u, False, active & ~by_edge)

    w = kind.wedges(row, views.use, active)
    ω = views.sample(w, it.p, u, active)
    n, _, outline = kind.open_side(row, on.dx, ω, active)
    probe = mi.Ray3f(it.p + on.offset * n + on.lead * ω, ω, 0, it.wavelengths)
    ω = dr.select(scene.ray_test(probe, active & by_edge & outline), -ω, ω)
    free = dr.zeros(mi.DirectionSample3f, dr.width(ω))
    free.d, free.dist = ω, varying(mi.Float, 2 * scene.bbox().bounding_sphere().radius)
    free.p = it.p + free.dist * ω
    free.emitter = dr.select(by_edge, mi.EmitterPtr(sky), ds.emitter)
    ds = dr.select(by_edge, free, ds)

    from_sky = active & (ds.emitter == mi.EmitterPtr(sky))
    pdf_em = scene.pdf_emitter_direction(it, ds, from_sky)
    pdf_edge = sum(views.pdf(w, it.p, d, active) for d in (ds.d, -ds.d))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -ds.d
    si.wavelengths = it.wavelengths
    value = dr.select(from_sky, sky.eval(si, from_sky), weight * ds.pdf)
    pdf = dr.select(from_sky, EDGE_SHARE * pdf_edge + (1 - EDGE_SHARE) * pdf_em, (1 - EDGE_SHARE) * ds.pdf)
    return ds, value, pdf


def _from_contour(
    scene: mi.Scene, kind: ContourKind, row: mi.UInt32, t: mi.Float, it, u: mi.Point2f, active: mi.Bool
) -> LightLine:
    """A contour depends on where it is seen from: the emitter is sampled without regard to where it shines.

    Points of area lights are drawn by area and weighed by dω = cosθ dA / r² once the contour point is known.
    """
    index, inv_pmf, reused = scene.sample_emitter(u.x, active)
    u = mi.Point2f(reused, u.y)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
    on_surface = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    elsewhere = active & ~on_surface
    ps, inv_pdf_area = emitter.sample_position(0, u, on_surface)
    ps.n = _normal_of(ps, emitter, u, on_surface)
    it.p = kind.inside(row, active)
    ds, _ = emitter.sample_direction(it, u, elsewhere)
    infinite = elsewhere & mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
    eye = dr.select(infinite, ds.d, mi.Vector3f(dr.select(on_surface, ps.p, ds.p)))
    on = kind.on(row, t, mi.Vector4f(eye.x, eye.y, eye.z, dr.select(infinite, 0.0, 1.0)), active)
    dist = dr.select(infinite, ds.dist, dr.norm(eye - on.x))
    ω = dr.select(infinite, ds.d, mi.Vector3f(eye - on.x) / dist)

    it.p = on.x
    ds_at_x, weight = emitter.sample_direction(it, u, elsewhere)  # a lamp's falloff is that towards x
    si = mi.SurfaceInteraction3f(ps, it.wavelengths)
    si.wi = si.to_local(-ω)
    cos_θ = dr.maximum(-dr.dot(ps.n, ω), 0)
    by_area = emitter.eval(si, on_surface) * cos_θ / dr.square(dist)
    value = dr.select(on_surface, by_area, weight * ds_at_x.pdf)
    pdf = dr.select(on_surface, dr.select(inv_pdf_area > 0, dr.rcp(inv_pdf_area), 0), ds_at_x.pdf)
    pmf = dr.select(inv_pmf > 0, dr.rcp(inv_pmf), 0)
    n_perp, across = on.across(ω)
    valid = on.valid & (across > 0) & kind.shades(row, on, ω, active)
    return LightLine(on, n_perp, across, ω, dist, emitter, value, pdf * pmf, valid)


def _normal_of(ps: mi.PositionSample3f, emitter: mi.EmitterPtr, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
    """The normal at the point `ps` that `u` gave: Mitsuba 3.9's `sphere` leaves out how it is turned.

    The opposite point of the sphere has the opposite local direction, hence the opposite (u, v): φ + π and −z.
    """
    shape = emitter.get_shape()
    sphere = active & (shape.shape_type() == mi.UInt32(mi.ShapeType.Sphere))
    opposite = mi.Point2f(dr.select(u.x < 0.5, u.x + 0.5, u.x - 0.5), 1 - u.y)
    across = ps.p - emitter.sample_position(0, opposite, sphere)[0].p
    outward = dr.normalize(dr.select(shape.has_flipped_normals(), -across, across))
    return dr.select(sphere, outward, ps.n)
