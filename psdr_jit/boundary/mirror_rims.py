"""Dark rims of smooth-shaded mirrors and glass: too narrow to be resolved, or not.

Near outlines of a smooth-shaded mesh, mirrors reflect under their own faces (`chain_surface`). With d the direction of
sight, n a face's normal and h = n_s·d for the interpolated one, the mirrored direction is d − 2 h n_s, and under the
face where

    0 < h / (n·d) < 1 / (2 n·n_s).

Such a rim begins at a shading outline or at an edge, which `primary` samples, and ends at a horizon within the face,
which `chain` searches for across the film; on a fine mesh or in a small image it is narrower than any search resolves.
Whether it is, is asked of the face as a whole, so that both terms agree: on faces whose rims are narrower than `RIM`,
`primary` looks at what the face reflects beyond, and `chain` leaves the horizon out. Steps from the background to the
rim and from the rim to what is beyond move alike and add up to the one that is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import look_at
from ..edges.shading_curve import Face
from ..scene.facts import SceneFacts
from .chain_outline import CORNERS
from .chain_surface import goes_under

#: Width of a rim up to which it is taken for nothing [px]: several times that at which the search for horizons ends.
RIM = 2.0**-9

#: How far beyond a rim the face is looked at, as a multiple of h where the rim ends.
BEYOND = 1.25

#: Cosine of the angle between shading normal and face from which on a mesh's faces are flat as far as rounding tells.
FLAT = 1 - 1e-7


def has_rims(facts: SceneFacts) -> bool:
    """May there be any?"""
    return facts.has_delta_lobes and any(s.smooth for s in facts.shapes)


@dataclass
class Rim:
    """Of the face that a line of sight meets. Detached."""

    there: mi.Bool  # has it one, and is that what is met?
    width: mi.Float  # from h = 0 to where it ends, on the film [px]
    beyond: mi.Vector2f  # how far it is to what is seen beyond, in barycentric coordinates

    @staticmethod
    def of(si: mi.SurfaceInteraction3f, pi, d: mi.Vector3f, J_px: mi.Float, active: mi.Bool) -> Rim:
        """`pi`: what has been met, `si`: its interaction, `d`: unit direction of sight."""
        n_s = si.sh_frame.n
        bent = active & pi.shape.is_mesh() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaReflection)
        bent &= dr.abs(dr.dot(si.n, n_s)) < FLAT
        corners = [_at_corner(pi, uv, si.wavelengths, bent) for uv in CORNERS]
        face = Face([corner.p for corner in corners], [corner.sh_frame.n for corner in corners])
        n, m = face.normal(pi.prim_uv), face.gradient(d, pi.prim_uv)
        end = dr.norm(n) * dr.dot(si.n, d) / (2 * dr.dot(si.n, n_s))
        slope = dr.norm(m)
        across = dr.norm(m - dr.dot(m, d) * d) / slope
        width = dr.abs(end) / slope * across * dr.rsqrt(J_px)
        beyond = face.barycentric(m * ((BEYOND * end - dr.dot(n, d)) / dr.square(slope)))
        there = bent & goes_under(si, d - 2 * dr.dot(n_s, d) * n_s)
        return Rim(there & dr.all(dr.isfinite(beyond)), width, mi.Vector2f(beyond))


def _at_corner(pi, uv: tuple, wavelengths, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """What is at a corner of the face that has been met."""
    moved = mi.PreliminaryIntersection3f(pi)
    moved.prim_uv = mi.Point2f(uv)
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1), 0, wavelengths)
    return moved.compute_surface_interaction(ray, mi.RayFlags.ShadingFrame, active)


def look_beyond(seen, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> mi.PreliminaryIntersection3f:
    """What is met beside the edge points `seen` of primary edges, beyond narrow rims."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, pi.is_valid())
    rim = Rim.of(si, pi, ray.d, seen.view.J_px, pi.is_valid())
    found = mi.PreliminaryIntersection3f(pi)
    found.prim_uv = pi.prim_uv + dr.select(rim.there & (rim.width < RIM), rim.beyond, 0)
    return found


def is_counted(lines, pair, line, sight) -> mi.Bool:
    """Does a crossing count? It does unless it is a horizon seen by the camera, and ends a narrow rim or lies on an
    edge, which is left to `primary`. `sight`: the segment that meets the crossed curve.
    """
    seen = pair.horizon & (pair.sight == 0)
    pi = sight.intersection()
    si = pi.compute_surface_interaction(mi.Ray3f(sight.o, sight.d), mi.RayFlags.All, seen)
    n = si.sh_frame.n
    reflected = dr.dot(n, pair.a.d) * dr.dot(n, sight.d) < 0
    view = look_at(lines.job.frame, si.p, line.aperture)
    narrow = reflected & (Rim.of(si, pi, sight.d, view.J_px, seen).width < RIM)
    return ~seen | (pair.one_face & ~narrow)
