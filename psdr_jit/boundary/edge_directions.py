"""Directions in which an edge can matter: the lune of silhouettes, and the wedge in which both faces are seen.

Around an edge with tangent τ, measure the azimuth φ of the *viewer's* direction from face 0 through its outer side.
Face 1 lies at φ = π + α, α the signed exterior angle (> 0 convex). In turn come the azimuths

    [0, α)  silhouette    [α, π)  both fronts: a crease    [π, π + α)  silhouette    [π + α, 2π)  inside, or both backs

(for α < 0 shifted by α, the silhouettes then lie inside the solid). A border has one face and matters everywhere. The
polar angle about τ is uniform in its cosine, so pdf_ω = p(φ) / 2 with p piecewise constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edge_set import EdgeRows
from .film_weights import FULL_CREASE

#: Relative density of the crease wedge for seams that have no angle (textures, split normals).
SEAM_DENSITY = 0.25


@dataclass
class Wedges:
    """Relative densities of the four azimuth ranges of an edge; detached."""

    start: mi.Float  # azimuth at which the first silhouette range begins: min(0, α)
    α: mi.Float  # |α|
    silhouette: mi.Float  # density in both silhouette ranges
    front: mi.Float  # density where both fronts are seen
    back: mi.Float  # density in the remaining range


def wedges(e: EdgeRows) -> Wedges:
    """Where edge rows `e` can matter. Densities are positive wherever a contribution is possible."""
    τ = dr.normalize(e.p1 - e.p0)
    into0, into1 = dr.cross(e.n0, τ), dr.cross(τ, e.n1)
    turn = dr.atan2(dr.dot(into1, e.n0), dr.dot(into1, into0))
    α = dr.select(turn < 0, turn + dr.pi, turn - dr.pi)  # signed: azimuth of face 1 minus π
    crease = dr.clip(e.angle / FULL_CREASE, 0, 1)
    crease = dr.select(e.seam, dr.select(e.angle < 1e-2, dr.maximum(crease, SEAM_DENSITY), crease), 0)
    closed = e.shell > 0  # a closed surface seen from outside
    silhouette = dr.select(closed & (α < 0), 0.0, 1.0)
    back = dr.select(closed, 0, crease)
    return Wedges(
        start=dr.minimum(α, 0),
        α=dr.select(e.border | e.traced, 0, dr.abs(α)),
        silhouette=silhouette,
        front=dr.select(e.border | e.traced, 1, crease),
        back=dr.select(e.border | e.traced, 1, back),
    )


def wedge_measure(w: Wedges) -> mi.Float:
    """∫ density dφ: how much an edge matters per length."""
    return 2 * w.silhouette * w.α + (w.front + w.back) * (dr.pi - w.α)


def _azimuth_density(w: Wedges, φ: mi.Float) -> mi.Float:
    """Unnormalised density at azimuth φ, counted from `w.start`, in [0, 2π)."""
    first_half = φ < dr.pi
    local = dr.select(first_half, φ, φ - dr.pi)
    return dr.select(local < w.α, w.silhouette, dr.select(first_half, w.front, w.back))


def sample_direction(e: EdgeRows, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """Direction ω from the viewer's side through the edge, and its density per solid angle: `(ω, pdf_sa)`."""
    w = wedges(e)
    lengths = [w.α, dr.pi - w.α, w.α, dr.pi - w.α]
    densities = [w.silhouette, w.front, w.silhouette, w.back]
    total = wedge_measure(w)
    x = u.x * total
    φ, begin = mi.Float(0), mi.Float(0)
    found = mi.Bool(False)
    for length, density in zip(lengths, densities, strict=True):
        mass = length * density
        here = ~found & (x < mass)
        φ = dr.select(here, begin + x / density, φ)
        found |= here
        x -= mass
        begin += length
    pdf = dr.select(found & (total > 0), _azimuth_density(w, φ) / (2 * total), 0)

    τ = dr.normalize(mi.Vector3f(e.p1 - e.p0))
    sin, cos = dr.sincos(w.start + φ)
    polar = 1 - 2 * u.y
    viewer = dr.safe_sqrt(1 - dr.square(polar)) * (cos * dr.cross(e.n0, τ) + sin * e.n0) + polar * τ
    return -mi.Vector3f(viewer), pdf


def pdf_direction(e: EdgeRows, ω: mi.Vector3f) -> mi.Float:
    """Density per solid angle of `sample_direction`."""
    w = wedges(e)
    τ = dr.normalize(mi.Vector3f(e.p1 - e.p0))
    φ = dr.atan2(dr.dot(-ω, e.n0), dr.dot(-ω, dr.cross(e.n0, τ))) - w.start
    φ = dr.select(φ < 0, φ + dr.two_pi, φ)
    total = wedge_measure(w)
    return dr.select(total > 0, _azimuth_density(w, φ) / (2 * total), 0)
