"""Forward derivative where no path changes: taken along the primal walk, with nothing recorded.

While only materials and emission depend on θ, directions and measures are constants. What is left of the derivative of
a path is

    dL = Σ_k [ β̇_k L_k + β_k (L̇_e,k + ḟ_k(ω_em) L_em + f_k(ω_em) L̇_em) ],      β̇_{k+1} = β̇_k w_k + β_k ḟ_k(ω_{k+1}) / p

with L_k what vertex k emits and scatters from an emitter sample ω_em; of a delta lobe, f is its value
(`paths/delta_step.py`) and p its probability. It is `sweeps.forward_sweep` of the resting flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import tangents
from ..paths.delta_step import delta_step
from ..paths.rough_plastic import RoughPlastic, eval_attached
from ..paths.sink import NoSink, Scatter


@dataclass
class MaterialTangents(NoSink):
    """A sink of `paths.walk.walk` that sums up derivatives; a PyTree, so that it is part of the loop's state."""

    dL: mi.Spectrum  # derivative of the path's radiance so far
    β_grad: mi.Spectrum  # of the throughput
    delta_lobes: bool  # whether the scene has any
    rough_plastic: RoughPlastic | None  # whose tables depend on a parameter

    @classmethod
    def zero(cls, delta_lobes: bool, rough_plastic: RoughPlastic | None) -> MaterialTangents:
        return cls(mi.Spectrum(0), mi.Spectrum(0), delta_lobes, rough_plastic)

    def scattered(self, k: mi.UInt32, s: Scatter, active: mi.Bool) -> None:
        """Add what vertex `k` contributes, and carry the throughput's derivative on."""
        ctx = mi.BSDFContext()
        nee, onward = s.nee, s.onward
        delta = onward.alive & onward.scattering.delta
        with dr.resume_grad():
            f_em = eval_attached(self.rough_plastic, s.si, s.bsdf, nee.ω, nee.seen)
            f = eval_attached(self.rough_plastic, s.si, s.bsdf, onward.scattering.wo, onward.alive & ~delta)
            if self.delta_lobes:
                step = delta_step(ctx, s.si, s.bsdf, s.si.to_world(onward.scattering.wo), delta)
                f = dr.select(delta, step.value, f)
            f_em_grad, f_grad = tangents(f_em, f)
        from_emitter = nee.mis * nee.value
        L = s.met.mis * s.met.value + dr.select(nee.seen, dr.detach(f_em) * from_emitter, 0)
        own = dr.select(nee.seen, f_em_grad * from_emitter, 0) + self._from_lights(s, dr.detach(f_em))
        self.dL += dr.select(active, self.β_grad * L + s.β * own, 0)
        weight = onward.scattering.weight / onward.survival
        β_grad = self.β_grad * weight + dr.select(onward.alive, s.β * f_grad * onward.likelihood().inv_pdf(), 0)
        self.β_grad = dr.select(active & onward.alive, β_grad, self.β_grad)

    def _from_lights(self, s: Scatter, f_em: mi.Spectrum) -> mi.Spectrum:
        """What the vertex sends back because lights change."""
        return mi.Spectrum(0)


@dataclass
class RadianceTangents(MaterialTangents):
    """The same where emission depends on θ as well."""

    def _from_lights(self, s: Scatter, f_em: mi.Spectrum) -> mi.Spectrum:
        emits = s.met.mis > 0
        nee = s.nee
        with dr.resume_grad():
            met_grad, sampled_grad = tangents(s.met.emitter.eval(s.si, emits), _radiance(s))
        direct = dr.select(nee.seen & (nee.ds.pdf > 0), f_em * sampled_grad * nee.mis / nee.ds.pdf, 0)
        return dr.select(emits, s.met.mis * met_grad, 0) + direct


def _radiance(s: Scatter) -> mi.Spectrum:
    """What the emitter sample sends, attached: `eval`, which all lights have, and for delta ones their own sampling."""
    ds, seen = s.nee.ds, s.nee.seen
    source = mi.SurfaceInteraction3f(ds, s.si.wavelengths)
    infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    source.wi = dr.select(infinite, -ds.d, source.to_local(-ds.d))
    delta = seen & ds.delta
    value = ds.emitter.eval(source, seen & ~delta)
    _, of_delta = ds.emitter.sample_direction(s.si, mi.Point2f(0.5), delta)
    return dr.select(delta, of_delta, value)
