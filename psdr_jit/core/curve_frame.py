"""The texture coordinate u of Mitsuba's curves: turns about the tangent, from the direction nearest to the z axis.

With the unit tangent t, let b be the unit vector at right angles to it that is nearest to z (y where t is along z) and
a = b × t. The direction of u is cos 2πu a + sin 2πu b, and (a, b, t) is right-handed. The frame turns with the tangent,
and about it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def curve_frame(t: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """`(a, b)` of unit tangents; attached to them."""
    b = mi.Vector3f(0, 0, 1) - t * t.z
    leans = dr.squared_norm(b) > 0
    b = dr.select(leans, dr.normalize(dr.select(leans, b, mi.Vector3f(0, 1, 0))), mi.Vector3f(0, 1, 0))
    return dr.cross(b, t), b


def radial(t: mi.Vector3f, u: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The direction of u, and its derivative by it; attached to `t`."""
    a, b = curve_frame(t)
    sin, cos = dr.sincos(dr.two_pi * u)
    return cos * a + sin * b, dr.two_pi * (cos * b - sin * a)


def frame_turn(t: mi.Vector3f, dt: mi.Vector3f) -> mi.Float:
    """Turns of the frame about `t`, towards larger u, as t changes by `dt` (of which the part along t is ignored)."""
    a, _ = curve_frame(t)
    lean = 1 - dr.square(t.z)
    return dr.select(lean > 0, dr.inv_two_pi * t.z * dr.dot(dt, a) * dr.rsqrt(lean), 0)


def turns(t: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
    """u of a direction `n`, of any length and with any part along t; attached to both."""
    a, b = curve_frame(t)
    u = dr.atan2(dr.dot(b, n), dr.dot(a, n)) * dr.inv_two_pi
    return dr.select(u < 0, u + 1, u)
