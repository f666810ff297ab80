"""Where two rods that share an end sphere cut into each other, on the inner side of their bend.

Seen from the centre J of the sphere, of radius R, let u be the unit vector along a rod and s its growth of radius that
way. Its cone touches the sphere in a circle; with k = √(1 − s²) and P(x) = (u·x + R s) / k it is

    |x|² − R² = P²,        P ≥ 0 beyond the circle.

Two cones about one sphere thus meet where P₁ = P₂ ≥ 0, in a plane: along the part beyond both circles of an ellipse

    x = p + z e + y m,     y² = C − 2 B z − A z²,     z = z_c + a cos ψ,     y = √A a sin ψ

with w = u₁/k₁ − u₂/k₂ across the plane, p its point nearest to J, m across both rods and e within the plane and both.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .rod import Rod

#: |w| below which the rods leave the joint in one direction, and slope of P along e below which P is constant.
FOLDED, LEVEL = 1e-3, 1e-6


def crease(joint: mi.Vector3f, R: mi.Float, rods: list[Rod], away: list[float], t: mi.Float):
    """`(x, dx/dt, valid)` at t ∈ [0, 1] between the two `rods`; a rod lies along `away` (±1) times its axis. Detached.

    Not valid where there is none, or where it leaves one of the rods.
    """
    (u1, s1), (u2, s2) = ((rod.axis[0] * sign, rod.axis[1] * sign) for rod, sign in zip(rods, away, strict=True))
    inv1, inv2 = (dr.rsqrt(1 - dr.square(s)) for s in (s1, s2))
    g1, h1, h2 = u1 * inv1, R * s1 * inv1, R * s2 * inv2
    w = g1 - u2 * inv2
    across = dr.cross(u1, u2)
    m = dr.select(dr.squared_norm(across) > dr.square(FOLDED), dr.normalize(across), mi.coordinate_system(u1)[0])
    p = w * ((h2 - h1) / dr.squared_norm(w))
    e = dr.normalize(dr.cross(m, w))
    e = dr.select(dr.dot(g1, e) < 0, -e, e)

    g, P = dr.dot(g1, e), dr.dot(g1, p) + h1
    A, B, C = 1 - dr.square(g), -P * g, dr.square(R) + dr.square(P) - dr.squared_norm(p)
    room = dr.square(B) + A * C
    z_c, a = -B / A, dr.safe_sqrt(room) / A
    first = dr.select(g > LEVEL, -P / g, dr.select(P >= 0, -dr.inf, dr.inf))  # z from which P ≥ 0
    widest = dr.acos(dr.clip((first - z_c) / a, -1, 1))
    sin, cos = dr.sincos((2 * t - 1) * widest)
    high = dr.safe_sqrt(A) * a
    x = joint + p + (z_c + a * cos) * e + high * sin * m
    dx = 2 * widest * (high * cos * m - a * sin * e)
    valid = rods[0].has_side & rods[1].has_side & (dr.norm(w) > FOLDED) & (A > 0) & (room > 0) & (widest > 0)
    for rod in rods:
        v = rod.foot(mi.Point3f(x))
        valid &= (v > 0) & (v < 1)
    return mi.Point3f(x), dx, valid
