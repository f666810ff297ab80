"""Directions in which an edge can matter: the lune of silhouettes, and the wedge in which both faces are seen.

Around an edge with tangent τ, measure the azimuth φ of the *viewer's* direction from face 0 through its outer side.
Face 1 lies at φ = π + α, α the signed exterior angle (> 0 convex). In turn come the azimuths

    [0, α)  silhouette    [α, π)  both fronts: a crease    [π, π + α)  silhouette    [π + α, 2π)  inside, or both backs

(for α < 0 shifted by α, the silhouettes then lie inside the solid). A border has one face and matters everywhere. The
polar angle about τ is uniform in its cosine, so pdf_ω = p(φ) / 2 with p piecewise constant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .rows import EdgeRows

#: Exterior angle from which a crease between two visible faces counts as much as a silhouette [rad].
FULL_CREASE = dr.pi / 4

#: Least relevance of seams at which textures or shading normals are split: the angle does not tell how much.
SEAM_RELEVANCE = 0.25

#: Factor on creases of smooth-shaded meshes, which show near the terminator of a light only.
SMOOTH_FACTOR = 0.25


@dataclass
class Wedges:
    """Relative densities of the four azimuth ranges of an edge; detached."""

    τ: mi.Vector3f  # unit tangent of the edge
    n: mi.Vector3f  # unit normal of face 0; azimuths are counted from n × τ towards n
    start: mi.Float  # azimuth at which the first silhouette range begins: min(0, α)
    α: mi.Float  # |α|
    first: mi.Float  # density in the first silhouette range
    front: mi.Float  # density where both fronts are seen
    second: mi.Float  # density in the second silhouette range
    back: mi.Float  # density in the remaining range

    @property
    def measure(self) -> mi.Float:
        """∫ density dφ: how much an edge matters per length."""
        return (self.first + self.second) * self.α + (self.front + self.back) * (dr.pi - self.α)

    def _density(self, φ: mi.Float) -> mi.Float:
        """Unnormalised density at azimuth φ, counted from `start`, in [0, 2π)."""
        first_half = φ < dr.pi
        local = dr.select(first_half, φ, φ - dr.pi)
        silhouette = dr.select(first_half, self.first, self.second)
        return dr.select(local < self.α, silhouette, dr.select(first_half, self.front, self.back))

    def sample(self, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Direction ω from the viewer's side through the edge, and its density per solid angle: `(ω, pdf_sa)`."""
        lengths = [self.α, dr.pi - self.α, self.α, dr.pi - self.α]
        densities = [self.first, self.front, self.second, self.back]
        total = self.measure
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
        pdf_sa = dr.select(found & (total > 0), self._density(φ) / (2 * total), 0)

        sin, cos = dr.sincos(self.start + φ)
        polar = 1 - 2 * u.y
        radius = dr.safe_sqrt(1 - dr.square(polar))
        viewer = radius * (cos * dr.cross(self.n, self.τ) + sin * self.n) + polar * self.τ
        return -mi.Vector3f(viewer), pdf_sa

    def pdf(self, ω: mi.Vector3f) -> mi.Float:
        """Density per solid angle of `sample`."""
        φ = dr.atan2(dr.dot(-ω, self.n), dr.dot(-ω, dr.cross(self.n, self.τ))) - self.start
        φ = dr.select(φ < 0, φ + dr.two_pi, φ)
        total = self.measure
        return dr.select(total > 0, self._density(φ) / (2 * total), 0)


def crease_relevance(e: EdgeRows) -> mi.Float:
    """How much an edge matters where both of its faces are seen, relative to a silhouette.

    What two faces reflect differs by about their angle: the finer a mesh, the less each of its creases matters.
    """
    crease = dr.clip(e.angle / FULL_CREASE, 0, 1) * dr.select(e.smooth, SMOOTH_FACTOR, 1)
    crease = dr.select(e.pattern, dr.maximum(crease, SEAM_RELEVANCE), crease)
    return dr.select(e.seam, crease, 0)


def signed_angle(e: EdgeRows) -> tuple[mi.Vector3f, mi.Float]:
    """Unit tangent τ, and the signed exterior angle α: azimuth of face 1 minus π."""
    τ = dr.normalize(mi.Vector3f(e.p1 - e.p0))
    into0, into1 = dr.cross(e.n0, τ), dr.cross(τ, e.n1)
    turn = dr.atan2(dr.dot(into1, e.n0), dr.dot(into1, into0))
    return τ, dr.select(turn < 0, turn + dr.pi, turn - dr.pi)


def step_wedges(e: EdgeRows) -> Wedges:
    """Where edges of meshes can matter at all. Densities are positive wherever a contribution is possible."""
    τ, α = signed_angle(e)
    crease = crease_relevance(e)
    closed = e.shell0 > 0  # a closed surface seen from outside
    silhouette = dr.select(closed & (α < 0), 0.0, 1.0)
    anywhere = e.border | e.traced
    return Wedges(
        τ=τ,
        n=mi.Vector3f(e.n0),
        start=dr.minimum(α, 0),
        α=dr.select(anywhere, 0, dr.abs(α)),
        first=silhouette,
        front=dr.select(anywhere, 1, crease),
        second=silhouette,
        back=dr.select(anywhere, 1, dr.select(closed, 0, crease)),
    )


def silhouette_wedges(e: EdgeRows) -> Wedges:
    """Where edges of meshes can be a silhouette; a border is one from everywhere."""
    around = dr.select(e.border | e.traced, 1.0, 0.0)
    return replace(step_wedges(e), front=around, back=around)


def meeting_wedges(e: EdgeRows) -> Wedges:
    """Where two surfaces cut into each other: a viewer is not inside of either that is closed.

    `e.shell0` and `e.shell1` tell which are; they are 0 along arcs, where normals turn, and all directions count.
    """
    τ, α = signed_angle(e)
    meets = (e.shell0 > 0) | (e.shell1 > 0)
    before0, before1 = dr.select(e.shell1 > 0, 0.0, 1.0), dr.select(e.shell0 > 0, 0.0, 1.0)  # in front of one only
    return Wedges(
        τ=τ,
        n=mi.Vector3f(e.n0),
        start=dr.minimum(α, 0),
        α=dr.select(meets, dr.abs(α), 0),
        first=dr.select(meets, dr.select(α < 0, before1, before0), 1),
        front=mi.Float(1),
        second=dr.select(meets, dr.select(α < 0, before0, before1), 1),
        back=dr.select(meets, 0.0, 1.0),
    )
