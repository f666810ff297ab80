"""Where reflection becomes total: directions in which an index of refraction changes most.

Inside of glass the reflected share F of a microfacet grows to 1 at the critical angle as 1 − √x, x the distance from
it, and its derivative by the index as 1/√x. Reflected light is sampled in proportion to F: the square of the
derivative over that density is 1/x, whose integral diverges, and the variance of an estimate with it. With a density
q that grows as 1/√x as well, a share of the samples that follow it bounds every weight.

With c = |ω_i·m| for a microfacet of normal m, and c_c its value at the critical angle, sin θ_c = η_t/η_i,

    c = c_c + Δ u²          p(c) = 1 / (2 √(Δ (c − c_c)))            c_c < c < c_c + Δ

turned about ω_i by an angle φ from the plane of ω_i and the surface normal, as a wrapped Cauchy distribution has it,

    φ = 2 atan(tanh(γ/2) tan(π (u − 1/2)))          p(φ) = sinh γ / (2π (cosh γ − cos φ))

since facets crowd around the normal. A direction mirrored there has the density q = p(c) p(φ) / (4 c) per solid angle.
Δ, γ and the share itself follow from the roughness α: away from the critical angle by more than that there is nothing
to be found. Below c_c, F is 1 and has no derivative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from ..scene.names import plugin_name

#: Largest share of a vertex' directions that are drawn in this way: of camera paths, and of light subpaths, which find
#: most of what is mirrored inside of glass.
CAMERA_SHARE, LIGHT_SHARE = 0.05, 0.5

#: Angle over which facets spread, in units of the roughness.
SPREAD = 0.7

#: Distance of a cosine from the critical one below which there is no derivative: it would be decided by rounding and by
#: the offsets of rays from surfaces. Costs √(BLUR/Δ), less than 1 %, of the derivative of what is reflected inside.
BLUR = 1e-5

#: Squared lengths below this one are 0.
LEAST = 1e-12


@dataclass
class _Lobe:
    """Of one vertex, detached. A direction has no density where `share` is 0."""

    share: mi.Float
    c: mi.Float  # cosine of the critical angle
    Δ: mi.Float
    γ: mi.Float
    up: mi.Float  # 1 or −1: the surface normal's side of the arriving direction


@dataclass(frozen=True)
class CriticalAngle:
    """Host object: rough glass whose index of refraction is differentiated, by registry index of its BSDF."""

    η: mi.Float  # relative index of refraction, inside to outside; 0: another material
    α: mi.Float  # roughness
    largest_share: float = CAMERA_SHARE

    def of_light(self) -> CriticalAngle:
        """The same for light subpaths."""
        return replace(self, largest_share=LIGHT_SHARE)

    def _lobe(self, bsdf: mi.BSDFPtr, wi: mi.Vector3f) -> _Lobe:
        index = dr.reinterpret_array(mi.UInt32, bsdf)
        known = index < varying(mi.UInt32, dr.width(self.η))
        η, α = (dr.gather(mi.Float, table, index, known) for table in (self.η, self.α))
        cos = mi.Frame3f.cos_theta(wi)
        sin_c = dr.select(cos < 0, dr.rcp(η), η)  # η_t/η_i
        inside = known & (η > 0) & (sin_c < 1)
        c = dr.safe_sqrt(1 - dr.square(sin_c))
        spread = dr.minimum(SPREAD * α, 1)
        off = (dr.abs(cos) - c) / (spread * sin_c)
        share = dr.select(inside, self.largest_share / (1 + dr.square(off)), 0)
        return _Lobe(share, c, dr.minimum(1 - c, spread), spread, dr.select(cos < 0, -1, 1))

    def share(self, bsdf: mi.BSDFPtr, wi: mi.Vector3f) -> mi.Float:
        """Share of the directions that are to be drawn here, for a path that arrives from `wi` (local)."""
        return self._lobe(bsdf, wi).share

    def sample(self, bsdf: mi.BSDFPtr, wi: mi.Vector3f, u: mi.Point2f) -> mi.Vector3f:
        """A local direction; it may lead through the surface, where it has no density."""
        lobe = self._lobe(bsdf, wi)
        c = dr.minimum(lobe.c + lobe.Δ * dr.square(u.x), 1)
        φ = 2 * dr.atan(dr.tanh(lobe.γ / 2) * dr.tan(dr.pi * (u.y - 0.5)))
        s, cos_φ, sin_φ = dr.safe_sqrt(1 - dr.square(c)), dr.cos(φ), dr.sin(φ)
        towards = mi.Vector3f(0, 0, lobe.up) - wi * dr.abs(wi.z)  # the normal, without what is along wi
        x = dr.select(dr.squared_norm(towards) > LEAST, dr.normalize(towards), mi.Frame3f(wi).s)
        m = c * wi + s * (cos_φ * x + sin_φ * dr.cross(wi, x))
        return dr.normalize(2 * c * m - wi)

    def pdf(self, bsdf: mi.BSDFPtr, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Float:
        """Density q of `sample` per solid angle."""
        lobe = self._lobe(bsdf, wi)
        m = dr.normalize(wi + wo)
        c = dr.dot(wi, m)
        p_c = 0.5 * dr.rsqrt(lobe.Δ * dr.maximum(c - lobe.c, BLUR))
        towards = mi.Vector3f(0, 0, lobe.up) - wi * dr.abs(wi.z)
        x = dr.select(dr.squared_norm(towards) > LEAST, dr.normalize(towards), mi.Frame3f(wi).s)
        across = m - c * wi
        cos_φ = dr.dot(across, x) * dr.rsqrt(dr.maximum(dr.squared_norm(across), LEAST))
        p_φ = dr.sinh(lobe.γ) * dr.inv_two_pi / (dr.cosh(lobe.γ) - cos_φ)
        reflected = mi.Frame3f.cos_theta(wi) * mi.Frame3f.cos_theta(wo) > 0
        found = reflected & (lobe.share > 0) & (c > lobe.c) & (c < lobe.c + lobe.Δ)
        return dr.select(found, p_c * p_φ / (4 * c), 0)

    def blurred(self, bsdf: mi.BSDFPtr, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Bool:
        """Is the turn from `wi` to `wo` at the critical angle, as far as one can tell?"""
        lobe = self._lobe(bsdf, wi)
        reflected = mi.Frame3f.cos_theta(wi) * mi.Frame3f.cos_theta(wo) > 0
        return reflected & (lobe.share > 0) & (dr.abs(dr.dot(wi, dr.normalize(wi + wo)) - lobe.c) < BLUR)


def critical_angle(scene: mi.Scene) -> CriticalAngle | None:
    """Read off the scene; None if it has no rough glass whose index has a gradient."""
    ids = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.shapes_dr().bsdf())]
    η, α = [0.0] * (max(ids, default=0) + 1), [1.0] * (max(ids, default=0) + 1)
    for k, shape in zip(ids, scene.shapes(), strict=True):
        bsdf = shape.bsdf()
        if bsdf is None or plugin_name(bsdf) != "roughdielectric":
            continue
        params = mi.traverse(bsdf)
        with dr.resume_grad():
            differentiated = dr.grad_enabled(params["eta"])
        if differentiated:
            η[k], α[k] = _number(params["eta"]), _roughness(params)
    if not any(η):
        return None
    tables = mi.Float(η), mi.Float(α)
    dr.make_opaque(*tables)
    return CriticalAngle(*tables)


def _roughness(params) -> float:
    """Mean roughness: of both directions, of all texels."""
    found = [_number(value) for name, value in params.items() if name.startswith("alpha") and _is_number(value)]
    return math.fsum(found) / len(found) if found else 1.0


def _is_number(value) -> bool:
    return isinstance(value, (int, float)) or hasattr(value, "shape")


def _number(value) -> float:
    return float(value) if isinstance(value, (int, float)) else float(dr.mean(dr.detach(value), axis=None)[0])
