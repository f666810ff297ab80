"""The height above surfaces at which Mitsuba starts rays (`Interaction::offset_p`, Mitsuba 3.9.1)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Share of it that is left out above a surface that one looks for from there, or looks up from.
INSIDE = 0.02


def start_height(x: mi.Point3f) -> mi.Float:
    """The height above a surface at `x` at which rays start [m]."""
    return mi.math.RayEpsilon * (1 + dr.max(dr.abs(x)))


def seen_side(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Vector3f:
    """Unit normal on the side of a surface that a ray of direction `d` meets. Detached."""
    n = mi.Vector3f(dr.detach(si.n))
    return dr.select(dr.dot(n, d) > 0, -n, n)
