"""Directions in which an edge can matter: the lune of silhouettes, and the wedge in which both faces are seen.

Around an edge with tangent τ, measure the azimuth φ of the *viewer's* direction from face 0 through its outer side.
Face 1 lies at φ = π + α, α the signed exterior angle (> 0 convex). In turn come the azimuths

    [0, α)  silhouette    [α, π)  both fronts: a crease    [π, π + α)  silhouette    [π + α, 2π)  inside, or both backs

(for α < 0 shifted by α, the silhouettes then lie inside the solid). A border has one face and matters everywhere. The
polar angle about τ is uniform in its cosine, so pdf_ω = p(φ) / 2 with p piecewise constant.

An edge of a shape that rests matters where its viewer is on something that moves: half of its directions are uniform
in the cone from which the ball around all movers is seen (one-sample balance heuristic [Veach 1997, §9.2.4]).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edges.rows import EdgeRows

#: Share of the directions of a resting edge that lead to the movers.
CONE_SHARE = 0.5

#: Exterior angle from which a crease between two visible faces counts as much as a silhouette [rad].
FULL_CREASE = dr.pi / 4

#: Least relevance of seams at which textures or shading normals are split: the angle does not tell how much.
SEAM_RELEVANCE = 0.25

#: Factor on creases of smooth-shaded meshes, which show near the terminator of a light only.
SMOOTH_FACTOR = 0.25


@dataclass
class Wedges:
    """Relative densities of the four azimuth ranges of an edge; detached."""

    start: mi.Float  # azimuth at which the first silhouette range begins: min(0, α)
    α: mi.Float  # |α|
    first: mi.Float  # density in the first silhouette range
    front: mi.Float  # density where both fronts are seen
    second: mi.Float  # density in the second silhouette range
    back: mi.Float  # density in the remaining range


def crease_relevance(e: EdgeRows) -> mi.Float:
    """How much an edge matters where both of its faces are seen, relative to a silhouette.

    What two faces reflect differs by about their angle: the finer a mesh, the less each of its creases matters.
    """
    crease = dr.clip(e.angle / FULL_CREASE, 0, 1) * dr.select(e.smooth, SMOOTH_FACTOR, 1)
    crease = dr.select(e.pattern, dr.maximum(crease, SEAM_RELEVANCE), crease)
    return dr.select(e.seam, crease, 0)


def wedges(e: EdgeRows) -> Wedges:
    """Where edge rows `e` can matter. Densities are positive wherever a contribution is possible."""
    τ = dr.normalize(e.p1 - e.p0)
    into0, into1 = dr.cross(e.n0, τ), dr.cross(τ, e.n1)
    turn = dr.atan2(dr.dot(into1, e.n0), dr.dot(into1, into0))
    α = dr.select(turn < 0, turn + dr.pi, turn - dr.pi)  # signed: azimuth of face 1 minus π
    crease = crease_relevance(e)
    closed = e.shell0 > 0  # a closed surface seen from outside
    silhouette = dr.select(closed & (α < 0), 0.0, 1.0)
    back = dr.select(closed, 0, crease)
    # Where two surfaces cut into each other, a viewer is not inside of either that is closed; an arc's normals turn.
    meets = (e.junction > 0) & ((e.shell0 > 0) | (e.shell1 > 0))
    before0, before1 = dr.select(e.shell1 > 0, 0.0, 1.0), dr.select(e.shell0 > 0, 0.0, 1.0)  # in front of one only
    anywhere = (e.border | e.traced) & ~meets
    return Wedges(
        start=dr.minimum(α, 0),
        α=dr.select(anywhere, 0, dr.abs(α)),
        first=dr.select(meets, dr.select(α < 0, before1, before0), silhouette),
        front=dr.select(anywhere | meets, 1, crease),
        second=dr.select(meets, dr.select(α < 0, before0, before1), silhouette),
        back=dr.select(meets, 0, dr.select(anywhere, 1, back)),
    )


def wedge_measure(w: Wedges) -> mi.Float:
    """∫ density dφ: how much an edge matters per length."""
    return (w.first + w.second) * w.α + (w.front + w.back) * (dr.pi - w.α)


def _azimuth_density(w: Wedges, φ: mi.Float) -> mi.Float:
    """Unnormalised density at azimuth φ, counted from `w.start`, in [0, 2π)."""
    first_half = φ < dr.pi
    local = dr.select(first_half, φ, φ - dr.pi)
    return dr.select(local < w.α, dr.select(first_half, w.first, w.second), dr.select(first_half, w.front, w.back))


def silhouette_wedges(e: EdgeRows) -> Wedges:
    """Where edge rows `e` can be a silhouette; a border is one from everywhere."""
    w = wedges(e)
    anywhere = e.border | e.traced
    around = dr.select(anywhere, 1.0, 0.0)
    return Wedges(w.start, w.α, w.first, around, w.second, around)


def background_wedges(e: EdgeRows) -> Wedges:
    """Where something behind edge rows `e` appears or disappears: silhouettes, and curves at which surfaces meet."""
    w, s = wedges(e), silhouette_wedges(e)
    meets = e.junction > 0
    front, second, back = (dr.select(meets, getattr(w, k), getattr(s, k)) for k in ("front", "second", "back"))
    return Wedges(w.start, w.α, w.first, front, second, back)


def sample_direction(e: EdgeRows, w: Wedges, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """Direction ω from the viewer's side through the edge, and its density per solid angle: `(ω, pdf_sa)`."""
    lengths = [w.α, dr.pi - w.α, w.α, dr.pi - w.α]
    densities = [w.first, w.front, w.second, w.back]
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


def pdf_direction(e: EdgeRows, w: Wedges, ω: mi.Vector3f) -> mi.Float:
    """Density per solid angle of `sample_direction`."""
    τ = dr.normalize(mi.Vector3f(e.p1 - e.p0))
    φ = dr.atan2(dr.dot(-ω, e.n0), dr.dot(-ω, dr.cross(e.n0, τ))) - w.start
    φ = dr.select(φ < 0, φ + dr.two_pi, φ)
    total = wedge_measure(w)
    return dr.select(total > 0, _azimuth_density(w, φ) / (2 * total), 0)


@dataclass
class Cone:
    """Directions within an angle of an axis; detached."""

    axis: mi.Vector3f
    open: mi.Float  # 1 − cos of the angle; 2: all directions

    @property
    def share(self) -> mi.Float:
        """Of all directions."""
        return self.open / 2

    def sample(self, u: mi.Point2f) -> mi.Vector3f:
        rise = u.x * self.open
        sin, cos = dr.sincos(dr.two_pi * u.y)
        radius = dr.safe_sqrt(rise * (2 - rise))
        return mi.Frame3f(self.axis).to_world(mi.Vector3f(radius * cos, radius * sin, 1 - rise))

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        inside = dr.squared_norm(d - self.axis) / 2 <= self.open
        return dr.select(inside, dr.inv_two_pi / self.open, 0)


def towards_sphere(x: mi.Point3f, centre: mi.Point3f, radius: mi.Float) -> Cone:
    """Directions from x to a ball; all of them from inside."""
    offset = mi.Vector3f(centre - x)
    dist2 = dr.squared_norm(offset)
    sin2 = dr.square(radius) / dist2
    outside = sin2 < 1
    axis = dr.select(outside, offset * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1))
    return Cone(axis, dr.select(outside, sin2 / (1 + dr.safe_sqrt(1 - sin2)), 2))


def sample_view(
    e: EdgeRows, w: Wedges, cone: Cone, rests: mi.Bool, ahead: float, u: mi.Point2f
) -> tuple[mi.Vector3f, mi.Float]:
    """As `sample_direction`, with the mixture for edges that rest: `(ω, pdf_sa)`.

    `ahead`: share of the cone's directions in which what moves is seen past the edge; otherwise the viewer is on it.
    """
    into_cone = rests & (u.x < CONE_SHARE)
    rescaled = dr.select(into_cone, u.x / CONE_SHARE, (u.x - CONE_SHARE) / (1 - CONE_SHARE))
    u = mi.Point2f(dr.select(rests, rescaled, u.x), u.y)
    ω, _ = sample_direction(e, w, u)
    forwards = u.x < ahead
    rescaled = dr.select(forwards, u.x / max(ahead, dr.smallest(mi.Float)), (u.x - ahead) / (1 - ahead))
    towards = cone.sample(mi.Point2f(rescaled, u.y))
    ω = dr.select(into_cone, dr.select(forwards, towards, -towards), ω)
    return ω, pdf_view(e, w, cone, rests, ahead, ω)


def pdf_view(e: EdgeRows, w: Wedges, cone: Cone, rests: mi.Bool, ahead: float, ω: mi.Vector3f) -> mi.Float:
    """Density per solid angle of `sample_view`."""
    pdf = pdf_direction(e, w, ω)
    in_cone = ahead * cone.pdf(ω) + (1 - ahead) * cone.pdf(-ω)
    return dr.select(rests, CONE_SHARE * in_cone + (1 - CONE_SHARE) * pdf, pdf)
