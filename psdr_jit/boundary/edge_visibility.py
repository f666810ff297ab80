"""Does the sensor see edge points, and what lies so close in front of them that it might be their own surface?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.lift import seen_side
from ..core.varying import varying
from ..edges.kind import Sight
from ..edges.points import VISIBILITY_EPSILON
from ..edges.table import EdgeTable
from ..paths.rays import ROUNDING, see_through_emitters
from ..paths.surface_at import surface_at
from ..plan.job import Job

#: How much farther from its face the place is at which what is seen from behind is looked at a second time.
FARTHER = 8


def hidden(job: Job, table: EdgeTable, sight: Sight, active: mi.Bool) -> mi.Bool:
    """Is there anything between the viewer and the edges? Hidden emitters are transparent. Detached.

    What has a face around it is aimed at from just above, on the viewer's side: rays along a face, or to what is behind
    an outline by rounding, may meet nothing at all. Flat faces are all met where they are. A ray that touches a ball
    may meet it anywhere about its outline: there the last of the way is gone a second time, and so it is where the edge
    does not say on which side of a surface it lies.
    """
    n = table.lies_in(sight)
    above = -dr.sign(dr.dot(n, sight.ω)) * sight.offset * n
    aim, body = table.aim(sight) + above, table.body(sight) + above
    ray = _between(sight.viewer, aim)
    sheet = _Sheet(body, n, ray.maxt + varying(mi.Float, job.facts.reach))
    nearly = ray.maxt * (1 - VISIBILITY_EPSILON)
    if _faceted(job):
        blocked = _has_behind_it(job, ray, sheet, active)
        unsure = dr.any(body != aim)
    else:
        blocked = _meets(job, ray, nearly, active)
        unsure = mi.Bool(True)
    blocked |= _has_behind_it(job, _between(ray(nearly), body), sheet, active & unsure & ~blocked)
    return blocked | _seen_through_a_crack(job, sight, aim, sheet, FARTHER * above, active & ~blocked)


def _seen_through_a_crack(job: Job, sight: Sight, aim: mi.Point3f, sheet: _Sheet, off: mi.Vector3f, active: mi.Bool):
    """Did rays to the back of a face slip through between two others? At an outline, where both are all but edge-on,
    the gap that rounding leaves is as wide as much of what is hidden there. They are gone a second time, to a place
    that is by `off` farther from the face, on the viewer's side.
    """
    from_behind = active & (dr.dot(sheet.n, sight.ω) > 0)
    nearer = replace(sheet, body=sheet.body + off)
    return _has_behind_it(job, _between(sight.viewer, aim + off), nearer, from_behind)


def _faceted(job: Job) -> bool:
    """Do rays meet nothing but flat faces?"""
    return all(shape.is_mesh or shape.plugin == "disk" or shape.kind == "instance" for shape in job.facts.shapes)


def _between(o: mi.Point3f, x: mi.Point3f) -> mi.Ray3f:
    """The way from `o` to `x`."""
    way = x - o
    length = dr.norm(way)
    ray = mi.Ray3f(o, way / length)
    ray.maxt = length
    return ray


@dataclass
class _Sheet:
    """What ends at an edge, or has it inside."""

    body: mi.Point3f  # a point of it, next to the edge
    n: mi.Normal3f  # unit, of the face that has the edge inside; else 0
    scale: mi.Float  # of the lengths that have been rounded [m]


def _has_behind_it(job: Job, ray: mi.Ray3f, sheet: _Sheet, active: mi.Bool) -> mi.Bool:
    """Do rays meet a surface that has the sheet behind it by more than rounding, or back to back with it?

    Faces in line with the viewer are met as well, but the edge lies in their plane. Behind an outline, what lies on the
    face that turns away is less than rounding behind the one that does not: a shading outline that leaves the outline
    by a hundredth of its length stays so for a fiftieth of an edge on a ball of 200 segments.
    """
    pi = job.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if job.options.hide_emitters:
        ray, pi = see_through_emitters(job.scene, ray, pi)
    si = surface_at(job.surfaces, pi, ray, mi.RayFlags.Minimal, active)
    met = seen_side(si, ray.d)
    depth = dr.dot(met, si.p - sheet.body)
    back_to_back = dr.dot(met, sheet.n) * dr.dot(sheet.n, ray.d) > 0
    return active & pi.is_valid() & (back_to_back | (depth > ROUNDING * sheet.scale))


def _meets(job: Job, ray: mi.Ray3f, length: mi.Float, active: mi.Bool) -> mi.Bool:
    """Do rays meet anything within a `length`?

    They are gone from their end: one that touches a sphere is met at a distance from it that grows with the square of
    how far away it starts, as `ray_test` of Mitsuba 3.9 calculates in single precision.
    """
    if job.options.hide_emitters:
        ray = mi.Ray3f(ray)
        ray.maxt = length
        pi = job.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        return see_through_emitters(job.scene, ray, pi)[1].is_valid()
    back = mi.Ray3f(ray(length), -ray.d)
    back.maxt = length
    return job.scene.ray_test(back, active)
