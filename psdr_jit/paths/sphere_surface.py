"""The surface of spheres, attached, from their table: as Mitsuba's `Sphere::compute_surface_interaction` has it.

Mitsuba finds the attached distance by the quadratic of the ray; here the ray meets the tangent plane of the point,
which moves with the centre c and the radius r. That is the same derivative,

    ṫ = (n·ċ + ṙ − n·(ȯ + t ḋ)) / (n·d)

without the small difference of large numbers that the discriminant is near an outline.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.sphere_table import COLUMNS, ROWS, SphereTable
from .own_surface import on_ray, where_active


def sphere_surface(
    table: SphereTable, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, follow: bool, active: mi.Bool
) -> dict:
    """What spheres say of their surface where `active`, by field; anything finite elsewhere."""
    shape = dr.reinterpret_array(mi.UInt32, pi.shape)
    which = dr.gather(mi.UInt32, table.place, shape, active) - 1
    e = [[1.0 if i == j else 0.0 for j in range(COLUMNS)] for i in range(ROWS)]
    rows = [dr.select(active, dr.gather(mi.Vector4f, table.poses, ROWS * which + i, active), mi.Vector4f(*e[i]))
            for i in range(ROWS)]  # fmt: skip
    x, y, z, c = (mi.Vector3f(*(row[j] for row in rows)) for j in range(COLUMNS))
    r, o, d, t = dr.norm(x), *where_active(ray, pi, active)
    q = dr.detach(o) + t * dr.detach(d)
    if follow:
        local = dr.detach(_inverse(x, y, z, q - c))
        p = mi.Point3f(local.x * x + local.y * y + local.z * z + c)
        n = mi.Normal3f((p - c) / r)
        t = dr.sqrt(dr.squared_norm(p - o) / dr.squared_norm(d))
    else:
        if dr.grad_enabled(rows, o, d):
            across = dr.detach(dr.normalize(q - c))
            p = mi.Point3f(dr.replace_grad(q, on_ray(o, d, t, across, c + r * across)))
            t = dr.replace_grad(t, dr.dot(p - o, dr.detach(d)))
        else:
            p = mi.Point3f(q)
        n = mi.Normal3f(dr.normalize(p - c))
        local = _inverse(x, y, z, p - c)
    outward = dr.gather(mi.Float, table.outward, which, active)
    n *= dr.select(active, outward, 1)
    return {"t": t, "p": p, "n": n, "shading": n, **_chart(local, x, y, z)}


def _inverse(x: mi.Vector3f, y: mi.Vector3f, z: mi.Vector3f, v: mi.Vector3f) -> mi.Vector3f:
    """Coordinates of `v` in the axes x, y, z."""
    yz = dr.cross(y, z)
    return mi.Vector3f(dr.dot(yz, v), dr.dot(dr.cross(z, x), v), dr.dot(dr.cross(x, y), v)) / dr.dot(x, yz)


def _chart(local: mi.Vector3f, x: mi.Vector3f, y: mi.Vector3f, z: mi.Vector3f) -> dict:
    """Azimuth and polar angle over 2 π and π, and the derivatives of the point by them."""
    φ = dr.atan2(local.y, local.x)
    φ = dr.select(φ < 0, φ + dr.two_pi, φ)
    up = dr.mulsign(mi.Float(1), local.z)  # the angle to the nearer pole, from the chord
    half = 0.5 * dr.sqrt(dr.square(local.x) + dr.square(local.y) + dr.square(local.z - up))
    near = 2 * dr.safe_asin(half)
    θ = dr.select(local.z >= 0, near, dr.pi - near)
    ρ2 = dr.square(local.x) + dr.square(local.y)
    pole = ρ2 == 0
    ρ = dr.sqrt(dr.select(pole, 1, ρ2))
    cos, sin = dr.select(pole, 1, local.x / ρ), dr.select(pole, 0, local.y / ρ)
    dp_du = dr.two_pi * (local.x * y - local.y * x)
    dp_dv = dr.pi * (local.z * (cos * x + sin * y) - dr.select(pole, 0, ρ) * z)
    uv = mi.Point2f(φ * dr.inv_two_pi, θ * dr.inv_pi)
    return {"uv": uv, "dp_du": dp_du, "dp_dv": dr.select(pole, dr.pi * x, dp_dv)}
