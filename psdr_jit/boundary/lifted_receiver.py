"""Where the receiver of a line lies, if rays start above surfaces.

Mitsuba starts the rays that leave a surface point x_D a height h above it (`Interaction::offset_p`, Mitsuba 3.9.1). A
line that meets a surface with normal n at x_0 under the angle θ, and passes an edge on its way, is the ray of the point
below its crossing of that height, and not of x_0:

    x_D = x_0 + h (ω/cosθ − n)

with ω back along the line. Next to an edge that lies close above a surface, and wherever something else hides x_0 or
x_D at that scale, the difference decides whether the sensor sees the step. An edge below the height blocks nothing.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.lift import INSIDE, seen_side, start_height
from ..core.records import Hit
from ..edges.points import LEAST_SLANT
from ..paths.surface_at import surface_at
from ..scene.surfaces import Surfaces

#: In heights, how far down from there one looks for it: large faces are rounded by about as much.
FAR_ENOUGH = 2.0


def lifted_receiver(
    scene: mi.Scene,
    surfaces: Surfaces | None,
    x: mi.Point3f,
    pi: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    active: mi.Bool,
) -> tuple[Hit, mi.Float, mi.Bool]:
    """`(receiver, above, found)` of a line `ray` past an edge point x that meets `pi`: x_D as the end of a ray in the
    same direction, how long before its end the line is at the height [m], and where there is such a point. Detached.

    None is found beyond a curve where two surfaces meet: the shadow that ends there is too thin to be in the image.
    """
    si = surface_at(surfaces, pi, ray, mi.RayFlags.Minimal, active)
    n = seen_side(si, ray.d)
    cos = -dr.dot(n, ray.d)
    height = start_height(si.p)
    # Along a line that grazes the surface we do not go so far back.
    lowered = height * dr.minimum(cos / LEAST_SLANT, 1)
    above = height / dr.maximum(cos, LEAST_SLANT)
    down = mi.Ray3f(si.p - ray.d * above, -n, FAR_ENOUGH * lowered, 0, ray.wavelengths)
    below = scene.ray_intersect_preliminary(down, coherent=False, active=active & (cos > 0))
    found = below.is_valid() & (dr.dot(n, x - si.p) > lowered)
    # What a large face is met at is rounded: it is the face itself, wherever that is.
    itself = (below.shape == pi.shape) & (below.prim_index == pi.prim_index)
    found &= itself | (dr.abs(below.t - lowered) <= INSIDE * lowered)
    x_D = down(below.t)
    below.t = pi.t
    return Hit.of(mi.Ray3f(x_D - ray.d * pi.t, ray.d, 0, ray.wavelengths), below), above, found
