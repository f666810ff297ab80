"""From a row of the junctions to a point of the curve: its place, and how it moves."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..paths.surface_at import surface_at
from ..scene.surfaces import Surfaces
from .junctions import JunctionRows, Sheet

#: Length of the ray by which a point of a ball or cylinder is addressed, relative to its coordinates.
PROBE = 1e-2


def on_a_ball(rows: JunctionRows, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
    """Are the junctions `index` arcs on a ball?"""
    radius = dr.gather(mi.Float, rows.arc_radius, index, active)
    axis = dr.gather(mi.Vector3f, rows.arc_axis, index, active)
    return (radius > 0) & (dr.squared_norm(axis) == 0)


def bend(rows: JunctionRows, index: mi.UInt32, x: mi.Point3f, dx: mi.Vector3f, active):
    """Carry a point of an arc's chord and its derivative onto the circle or ellipse; `index`: row of `rows`.

    Within the plane of the face, away from its centre, until the distance from there, or from the cylinder's axis
    through there, is the radius.
    """
    radius = dr.gather(mi.Float, rows.arc_radius, index, active)
    on_arc = active & (radius > 0)
    offset = mi.Vector3f(x - dr.gather(mi.Point3f, rows.arc_centre, index, on_arc))
    radial = _across(offset, dr.gather(mi.Vector3f, rows.arc_axis, index, on_arc))
    scale = radius / dr.norm(radial)
    bent = x + (scale - 1) * offset
    slope = scale * (dx - offset * (dr.dot(radial, dx) / dr.squared_norm(radial)))
    return dr.select(on_arc, bent, x), dr.select(on_arc, slope, dx)


def _across(v: mi.Vector3f, axis: mi.Vector3f) -> mi.Vector3f:
    """The part of v perpendicular to the unit vector `axis`; all of it if that is 0."""
    return v - axis * dr.dot(v, axis)


def junction_motion(
    rows: JunctionRows, index: mi.UInt32, t: mi.Float, x: mi.Point3f, surfaces: Surfaces | None, active
) -> mi.Vector3f:
    """Vector of value 0 whose derivative is the velocity of the curve at x, attached to both surfaces."""
    sheets = [dr.gather(Sheet, sheet, index, active) for sheet in (rows.a, rows.b)]
    n_a, n_b = (
        dr.select(s.is_round, dr.normalize(_across(mi.Vector3f(x - s.centre), s.axis)), mi.Vector3f(s.n))
        for s in sheets
    )
    moved_a, moved_b = (dr.dot(n, _moved(s, n, t, x, surfaces, active))
                        for n, s in zip((n_a, n_b), sheets, strict=True))  # fmt: skip
    c = dr.dot(n_a, n_b)
    scale = dr.rcp(dr.squared_norm(dr.cross(n_a, n_b)))  # 1 − c² without cancellation
    return (n_a - c * n_b) * scale * moved_a + (n_b - c * n_a) * scale * moved_b


def _moved(s: Sheet, n: mi.Vector3f, t: mi.Float, x: mi.Point3f, surfaces: Surfaces | None, active) -> mi.Vector3f:
    """Attached displacement (value 0) of the material point of a surface at x."""
    height = PROBE * (1 + dr.max(dr.abs(x)))
    hit = Hit(x + height * n, -n, height, s.shape, s.prim, s.uv_start + t * (s.uv_end - s.uv_start))
    follow = mi.RayFlags.Minimal | mi.RayFlags.FollowShape
    p = surface_at(surfaces, hit.intersection(), mi.Ray3f(hit.o, hit.d), follow, active).p
    return p - dr.detach(p)
