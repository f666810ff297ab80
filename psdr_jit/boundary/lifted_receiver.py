"""Where the receiver of a line lies, if rays start above surfaces.

Mitsuba starts the rays that leave a surface point x_D a height h above it (`Interaction::offset_p`, Mitsuba 3.9.1). A
line that meets a surface with normal n at x_0 under the angle θ, and passes an edge on its way, is the ray of the point
below its crossing of that height, and not of x_0:

    x_D = x_0 + h (ω/cosθ − n)

with ω back along the line. Next to an edge that lies close above a surface, and wherever something else hides x_0 or
x_D at that scale, the difference decides whether the sensor sees the step. An edge below the height blocks nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.lift import INSIDE, seen_side, start_height
from ..core.records import Hit
from ..core.sensor_frame import look_at
from ..edges.film_cover import LENS_CENTRE
from ..edges.kind import OnEdge
from ..edges.points import CLEAR_OF_LIFT, LEAST_SLANT, cot_between
from ..paths.surface_at import surface_at
from ..plan.job import Job

#: In heights, how far down from there one looks for it: large faces are rounded by about as much.
FAR_ENOUGH = 2.0


@dataclass
class Landing:
    """Where a line past an edge meets a surface; detached, one entry per line."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    p: mi.Point3f  # the point of the surface
    n: mi.Vector3f  # unit normal on the side that is met

    @staticmethod
    def of(job: Job, ray: mi.Ray3f, active: mi.Bool) -> Landing:
        """What `ray` meets."""
        pi = job.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si = surface_at(job.surfaces, pi, ray, mi.RayFlags.Minimal, active)
        return Landing(ray, pi, si.p, seen_side(si, ray.d))


def lifted_receiver(job: Job, landing: Landing, x: mi.Point3f, active: mi.Bool) -> tuple[Hit, mi.Float, mi.Bool]:
    """`(receiver, above, found)` of a line past an edge point x: x_D as the end of a ray in the same direction, how
    long before its end the line is at the height [m], and where there is such a point. Detached.

    None is found beyond a curve where two surfaces meet: the shadow that ends there is too thin to be in the image.
    """
    ray, pi, n = landing.ray, landing.pi, landing.n
    cos = -dr.dot(n, ray.d)
    height = start_height(landing.p)
    # Along a line that grazes the surface we do not go so far back.
    lowered = height * dr.minimum(cos / LEAST_SLANT, 1)
    slant = dr.maximum(cos, LEAST_SLANT)
    above = height / slant
    # The line was traced a little beside the edge: next to one close above the surface that is no small distance.
    beside = landing.p - x
    beside -= ray.d * dr.dot(ray.d, beside)
    end = landing.p - beside - ray.d * (dr.dot(n, beside) / slant)
    down = mi.Ray3f(end - ray.d * above, -n, FAR_ENOUGH * lowered, 0, ray.wavelengths)
    below = job.scene.ray_intersect_preliminary(down, coherent=False, active=active & pi.is_valid() & (cos > 0))
    found = below.is_valid() & (dr.dot(n, x - landing.p) > lowered)
    # What a large face is met at is rounded: it is the face itself, wherever that is.
    itself = (below.shape == pi.shape) & (below.prim_index == pi.prim_index)
    found &= itself | (dr.abs(below.t - lowered) <= INSIDE * lowered)
    x_D = down(below.t)
    below.t = pi.t
    return Hit.of(mi.Ray3f(x_D - ray.d * pi.t, ray.d, 0, ray.wavelengths), below), above, found


def ends_in_a_crease(
    job: Job,
    landing: Landing,
    above: mi.Float,
    on: OnEdge,
    n_perp: mi.Vector3f,
    face: mi.Normal3f,
    active: mi.Bool,
) -> mi.Bool:
    """Is x_D so near to where the edge's own `face` (unit normal) cuts into the receiver that the curve between both
    counts what lies between them?

    A face in line with a point or directional light casts its shadow along that curve. What lies next to the curve is
    looked at from past the dark of an overhanging face, which is h cot φ wide if the surfaces meet at an angle φ
    (`kind_junction.Junctions.side`), and a step that lies nearer is part of the step there. `above`: as of
    `lifted_receiver`; `n_perp`: to the open side.
    """
    ω, n = -landing.ray.d, landing.n
    sin = dr.maximum(dr.norm(dr.cross(face, n)), LEAST_SLANT)
    dark = start_height(landing.p) * cot_between(face, n)
    overhangs = dr.dot(face, n_perp) * dr.dot(face, n) < 0
    seen_along = look_at(job.frame, landing.p, mi.Point2f(LENS_CENTRE)).ω
    slant = dr.abs(dr.dot(n, seen_along)) / dr.norm(dr.cross(seen_along, dr.cross(face, n) / sin))
    aside = on.offset / dr.clip(slant, LEAST_SLANT, 1)
    looked_past = aside + CLEAR_OF_LIFT * dark - dr.select(overhangs, dark, -dark)
    to_face = dr.abs(dr.dot(face, ω)) * dr.dot(on.x - landing.p, ω) / sin  # along the receiver
    near = active & (dr.squared_norm(face) > 0) & (to_face < looked_past)
    towards = -dr.normalize(n_perp - dr.dot(n_perp, n) * n)
    to_curve = mi.Ray3f(landing.p + above * ω, towards, looked_past, 0, landing.ray.wavelengths)
    return near & job.scene.ray_test(to_curve, near)
