"""What Mitsuba leaves out of the derivative of rough plastic by its roughness and its index of refraction.

Below the coat of `roughplastic` lies a diffuse base: light gets in and out with the transmittance T of the rough coat,
and is reflected inside by its mean internal reflectance r [Jakob, `plastic` of Mitsuba 0.5],

    f_d = y T(cos θ_i) T(cos θ_o) cos θ_o / (π η²)       y = ρ / (1 − r), or, `nonlinear`, ρ / (1 − ρ r)

T is a table over cos θ, and r a number. Mitsuba computes them without derivatives when α or η changes; what is missing:

    ḟ_d = f_d [ Ṫ(cos θ_i)/T(cos θ_i) + Ṫ(cos θ_o)/T(cos θ_o) + z ṙ ]       z = 1 / (1 − r), or, `nonlinear`, y

T and r are integrals over microfacet normals m that are visible from a direction ω [Walter et al. 2007; Heitz 2014],

    T(cos θ) = E_m[ (1 − F(ω·m)) G₁(ω', m) ]       r = 2 ∫ E_m[ F(ω·m) G₁(ω', m) ] cos θ dcos θ

with ω' refracted from outside, or reflected inside. They are sums over the nodes that Mitsuba has, differentiated by
differences: the integrand of r has a kink at the critical angle, and the derivative of the sum is 2 % off that of the
integral, differences over `STEP` .2 %.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.varying import varying
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..scene.graph import named_children
from ..scene.names import plugin_name

PLUGIN = "roughplastic"
PARAMETERS = ("alpha", "eta")

TABLE = 64  # entries over cos θ, as in Mitsuba
NODES, NODES_INSIDE = 32, 128  # along each axis of the integrals T and r, as in Mitsuba
STEP, STEP_OF_α = 0.02, 0.2  # of central differences; the latter a share of α, if that is smaller
LEAST_COSINE = 1e-6

EVERY_COMPONENT = 0xFFFFFFFF


@dataclass(frozen=True)
class Tables:
    """Of one kind of coat, detached."""

    T: mi.Float  # (TABLE,)
    T_grad: tuple[mi.Float, mi.Float]  # by α and by η
    r: float
    r_grad: tuple[float, float]


@dataclass(frozen=True)
class _Coat:
    """Rough plastic on shapes of the scene."""

    bsdf: int  # registry index of the BSDF that the shapes have
    side: int  # on which it is that BSDF: 1 front, -1 back, 0 both
    nonlinear: bool
    tables: Tables
    α: mi.Float  # attached
    η: mi.Float


#: Of an integrator: tables by distribution, roughness and index.
TABLES: Slot[dict[tuple[str, float, float], Tables]] = Slot(dict)


class RoughPlastic:
    """Host object, and no PyTree: all rough plastic whose roughness or index is differentiated."""

    def __init__(self, coats: tuple[_Coat, ...]):
        self._coats = coats

    def missing(self, si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """What has to be added to `bsdf.eval` in the direction `wo` (local): of value 0, attached to α and η."""
        index = dr.reinterpret_array(mi.UInt32, bsdf)
        with dr.suspend_grad():
            here = mi.Bool(False)
            for coat in self._coats:
                here |= index == coat.bsdf
            base = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.DiffuseReflection), EVERY_COMPONENT)
            f = bsdf.eval(base, si, wo, active & here)
            front = mi.Frame3f.cos_theta(si.wi) > 0
            cosines = dr.abs(mi.Frame3f.cos_theta(si.wi)), dr.abs(mi.Frame3f.cos_theta(wo))
        found = mi.Spectrum(0)
        for coat in self._coats:
            side = True if coat.side == 0 else front == (coat.side > 0)
            found += dr.select((index == coat.bsdf) & side, _missing(coat, f, cosines), 0)
        return found


def eval_attached(
    plastic: RoughPlastic | None, si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """f cosθ in the direction `wo` (local), attached to all that it depends on. `plastic`: None if there is none."""
    f = bsdf.eval(mi.BSDFContext(), si, wo, active)
    return f if plastic is None else f + plastic.missing(si, bsdf, wo, active)


def _missing(coat: _Coat, f: mi.Spectrum, cosines: tuple[mi.Float, mi.Float]) -> mi.Spectrum:
    tables = coat.tables
    with dr.suspend_grad():
        T = [_look_up(tables.T, c) for c in cosines]
        η = dr.detach(coat.η)
        z = varying(mi.Float, 1 / (1 - tables.r))
        if coat.nonlinear:
            z = f * (dr.pi * dr.square(η)) / dr.maximum(T[0] * T[1] * cosines[1], dr.smallest(mi.Float))
        slopes = []
        for T_grad, r_grad in zip(tables.T_grad, tables.r_grad, strict=True):
            slopes.append(f * (sum(_look_up(T_grad, c) / t for c, t in zip(cosines, T, strict=True)) + z * r_grad))
    return slopes[0] * (coat.α - dr.detach(coat.α)) + slopes[1] * (coat.η - η)


def _look_up(table: mi.Float, cosine: mi.Float) -> mi.Float:
    """As Mitsuba does."""
    x = cosine * (TABLE - 1)
    k = dr.minimum(mi.UInt32(x), TABLE - 2)
    return dr.lerp(dr.gather(mi.Float, table, k), dr.gather(mi.Float, table, k + 1), x - mi.Float(k))


def rough_plastic(scene: mi.Scene, memory: Memory) -> RoughPlastic | None:
    """Read off the scene; None if it has none whose roughness or index has a gradient."""
    coats = []
    ids = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.shapes_dr().bsdf())]
    with dr.resume_grad():
        for index, shape in dict(zip(ids, scene.shapes(), strict=True)).items():
            _warn_about_hidden(shape, memory)
            for side, bsdf in coats_of(shape.bsdf()):
                if not _differentiated(bsdf):
                    continue
                params = mi.traverse(bsdf)
                α, η = (mi.Float(params[name]) for name in PARAMETERS)
                text = str(bsdf)
                kind = re.search(r"distribution = (\w+)", text)[1]
                tables = _tables(kind, *(float(dr.detach(x)[0]) for x in (α, η)), memory)
                coats.append(_Coat(index, side, "nonlinear = 1" in text, tables, α, η))
    return RoughPlastic(tuple(coats)) if coats else None


def _warn_about_hidden(shape: mi.Shape, memory: Memory) -> None:
    """Of rough plastic that a shape shows by way of another BSDF, whose frame or weight is not known here."""
    known = [bsdf for _, bsdf in coats_of(shape.bsdf())]
    for bsdf in _below(shape.bsdf()):
        if plugin_name(bsdf) == PLUGIN and bsdf not in known and _differentiated(bsdf):
            warn_once(
                f"the {PLUGIN} '{bsdf.id()}' is inside of a {plugin_name(shape.bsdf())}: what its base sends depends "
                "on its roughness and index by tables, whose derivative is missing there; put it on the shape itself",
                UnsupportedWarning, memory,
            )  # fmt: skip


def _below(bsdf: mi.BSDF | None) -> Iterator[mi.BSDF]:
    if bsdf is not None:
        yield bsdf
        for _, child in named_children(bsdf):
            if isinstance(child, mi.BSDF):
                yield from _below(child)


def _differentiated(bsdf: mi.BSDF) -> bool:
    params = mi.traverse(bsdf)
    return any(dr.grad_enabled(params[name]) for name in PARAMETERS)


def coats_of(bsdf: mi.BSDF | None) -> Iterator[tuple[int, mi.BSDF]]:
    """`(side, rough plastic)` that a BSDF is, or shows on its sides."""
    if bsdf is None:
        return
    if plugin_name(bsdf) == PLUGIN:
        yield 0, bsdf
    elif plugin_name(bsdf) == "twosided":
        sides = [child for _, child in named_children(bsdf) if isinstance(child, mi.BSDF)]
        places = (0,) if len(sides) == 1 else (1, -1)
        yield from ((place, child) for place, child in zip(places, sides, strict=True) if plugin_name(child) == PLUGIN)


def _tables(kind: str, α: float, η: float, memory: Memory) -> Tables:
    known = memory[TABLES]
    if (kind, α, η) not in known:
        known.clear()  # an optimisation comes to no value twice
        known[kind, α, η] = make_tables(kind, α, η)
    return known[kind, α, η]


def make_tables(kind: str, α: float, η: float) -> Tables:
    """T, r and their derivatives, for the distribution `kind`, "ggx" or "beckmann"."""
    distribution = {"ggx": mi.MicrofacetType.GGX, "beckmann": mi.MicrofacetType.Beckmann}[kind]

    def at(α: float, η: float) -> tuple[mi.Float, float]:
        values = varying(mi.Float, α), varying(mi.Float, η)
        return _transmittance(distribution, *values), float(_internal_reflectance(distribution, *values)[0])

    h = min(STEP, STEP_OF_α * α)
    T, r = at(α, η)
    T_grad, r_grad = [], []
    for above, below, step in ((at(α + h, η), at(α - h, η), h), (at(α, η + STEP), at(α, η - STEP), STEP)):
        T_grad.append((above[0] - below[0]) / (2 * step))
        r_grad.append((above[1] - below[1]) / (2 * step))
    dr.eval(T, T_grad)
    return Tables(T, tuple(T_grad), r, tuple(r_grad))


def _transmittance(kind: mi.MicrofacetType, α: mi.Float, η: mi.Float) -> mi.Float:
    """T at the cosines of the table."""
    return _over_normals(kind, α, NODES, lambda wi, m, distribution: _refracted(wi, m, distribution, η))


def _internal_reflectance(kind: mi.MicrofacetType, α: mi.Float, η: mi.Float) -> mi.Float:
    """r, a mean over the cosines of the table."""
    inside = _over_normals(kind, α, NODES_INSIDE, lambda wi, m, distribution: _reflected(wi, m, distribution, 1 / η))
    return 2 * dr.mean(inside * _cosines(dr.arange(mi.UInt32, TABLE)))


def _refracted(wi: mi.Vector3f, m: mi.Normal3f, distribution: mi.MicrofacetDistribution, η: mi.Float) -> mi.Float:
    F, cos_t, _, η_ti = mi.fresnel(dr.dot(wi, m), η)
    wo = mi.refract(wi, m, cos_t, η_ti)
    return dr.select(wo.z < 0, (1 - F) * distribution.smith_g1(wo, m), 0)


def _reflected(wi: mi.Vector3f, m: mi.Normal3f, distribution: mi.MicrofacetDistribution, η: mi.Float) -> mi.Float:
    F = mi.fresnel(dr.dot(wi, m), η)[0]
    wo = mi.reflect(wi, m)
    return dr.select(wo.z > 0, F * distribution.smith_g1(wo, m), 0)


def _over_normals(kind: mi.MicrofacetType, α: mi.Float, nodes: int, integrand) -> mi.Float:
    """Mean of `integrand(ω, m, distribution)` over visible normals m, for directions ω at the cosines of the table."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    x, weight = (mi.Float(np.float32(v)) for v in (x / 2 + 0.5, weight / 2))
    lane = dr.arange(mi.UInt32, TABLE * nodes**2)
    i, j = lane % nodes, lane // nodes % nodes
    cos = _cosines(lane // nodes**2)
    wi = mi.Vector3f(dr.safe_sqrt(1 - dr.square(cos)), 0, cos)
    distribution = mi.MicrofacetDistribution(kind, α, True)
    m, _ = distribution.sample(wi, mi.Point2f(dr.gather(mi.Float, x, i), dr.gather(mi.Float, x, j)))
    value = integrand(wi, m, distribution) * dr.gather(mi.Float, weight, i) * dr.gather(mi.Float, weight, j)
    return dr.block_sum(value, nodes**2)


def _cosines(k: mi.UInt32) -> mi.Float:
    return dr.maximum(LEAST_COSINE, mi.Float(k) / (TABLE - 1))
