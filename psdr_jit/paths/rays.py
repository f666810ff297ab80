"""What a ray meets: first hits of camera rays, shadow rays, and the surface at the end of a ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from .bounce import PathLimits
from .surface_at import surface_at

#: Relative shortening of a shadow ray, as in Mitsuba's `Interaction::spawn_ray_to` (`math::ShadowEpsilon`).
SHADOW_EPSILON = 1e-3

#: What is added for the rounding of float32 positions, relative to the coordinates: eight units in the last place.
ROUNDING = 1e-6

#: Distance that a ray advances beyond what it passes through, relative to the coordinates. It may meet that once more,
#: by rounding, and passes it again; with ten times as much it would miss a floor below, next to where the two meet.
ADVANCE = 1e-6


def shadow_test(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool):
    """Is the emitter sample visible from `si`? Any-hit ray; returns `(hit, visible)` with an empty hit."""
    occluded = scene.ray_test(si.spawn_ray_to(ds.p), active)
    return Hit.made(dr.zeros, 1), active & ~occluded


def shadow_hit(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool):
    """The same with a closest-hit ray, which also tells *which* point of an area light was reached.

    With it the light's own motion can be attached later without another ray. Returns `(hit, visible)`. All lengths are
    those of the ray, which Mitsuba starts above the surface: of light from nearby, that height is a good part.
    """
    ray = si.spawn_ray_to(ds.p)
    on_surface = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    dist = dr.norm(ds.p - ray.o)
    slack = SHADOW_EPSILON * dist + ROUNDING * dr.max(dr.abs(ds.p))
    ray.maxt = dr.select(on_surface, dist + slack, ray.maxt)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    reached = pi.is_valid() & (pi.t >= dist - slack) & (pi.shape.emitter() == ds.emitter)
    return Hit.of(ray, pi), active & dr.select(on_surface, reached, ~pi.is_valid())


def skip_emitters(scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f):
    """Pass through area emitters as images do: the ray restarted behind the last one, and what it meets.

    Mitsuba lifts its origin off the surface, and so shifts the ray to the side.
    """
    return _behind_emitters(scene, ray, pi, _lifted)


def see_through_emitters(scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f):
    """The same along the line itself: what rays meet that aim at an edge, or pass by it at a smaller distance."""
    return _behind_emitters(scene, ray, pi, _advanced)


def _lifted(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> mi.Ray3f:
    behind = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal).spawn_ray(ray.d)
    # its origin lies off the surface: measured from there, or rays would end as much later
    behind.maxt = ray.maxt - dr.dot(behind.o - ray.o, ray.d)
    return behind


def _advanced(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> mi.Ray3f:
    behind = mi.Ray3f(ray)
    t = pi.t + ADVANCE * (1 + dr.max(dr.abs(ray.o)) + pi.t)
    behind.o, behind.maxt = ray(t), ray.maxt - t
    return behind


@dr.syntax
def _behind_emitters(scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, restarted):
    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array comparison)
    while dr.hint(active, label="psdr.behind_emitters", exclude=[restarted]):
        ray = restarted(ray, pi)
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        active &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return ray, pi


def first_hit(scene: mi.Scene, ray: mi.Ray3f, hide_emitters: bool):
    """First vertex seen by a camera ray: `(ray, pi, emission)`, `emission` = lanes that count what it emits."""
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    if not hide_emitters:
        return ray, pi, mi.Bool(True)
    ray, pi = skip_emitters(scene, ray, pi)
    return ray, pi, mi.Bool(False)


def interaction(pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, limits: PathLimits) -> mi.SurfaceInteraction3f:
    """The surface that `ray` meets. Unless `limits.own_frames`, its shading frame depends on the normal alone.

    Mitsuba takes the tangents of a mesh without texture coordinates from the first side of each triangle: with equal
    random numbers, a path would go on in another direction from the next triangle of the same plane, and the difference
    of radiance across their edge, which is nearly 0, would be noise.
    """
    si = surface_at(limits.surfaces, pi, ray, mi.RayFlags.All)
    if limits.own_frames:
        return si
    si.sh_frame = mi.Frame3f(si.sh_frame.n)
    si.wi = dr.select(si.is_valid(), si.to_local(-ray.d), si.wi)
    return si
