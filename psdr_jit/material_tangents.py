"""Forward derivative where only materials depend on θ: taken along the primal walk, with nothing recorded.

Directions, measures and emission are constants then; what is left of the derivative of a path is

    dL = Σ_k [ β̇_k L_k + β_k ḟ_k(ω_em) L_em ],      β̇_{k+1} = β̇_k w_k + β_k ḟ_k(ω_{k+1}) / p

with L_k what vertex k emits and scatters from an emitter sample ω_em. It is `interior.forward_sweep` of these scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .ad import tangents
from .path_steps import NoSink, Scatter


@dataclass
class MaterialTangents(NoSink):
    """A sink of `path_steps.walk` that sums up derivatives; a PyTree, so that it is part of the loop's state."""

    dL: mi.Spectrum  # derivative of the path's radiance so far
    β_grad: mi.Spectrum  # of the throughput

    @staticmethod
    def zero() -> MaterialTangents:
        return MaterialTangents(mi.Spectrum(0), mi.Spectrum(0))

    def scattered(self, k: mi.UInt32, s: Scatter, active: mi.Bool) -> None:
        """Add what vertex `k` contributes, and carry the throughput's derivative on."""
        ctx = mi.BSDFContext()
        smooth = s.goes_on & ~s.delta
        with dr.resume_grad():
            f_em = s.bsdf.eval(ctx, s.si, s.ω_em, s.sees_emitter)
            f = s.bsdf.eval(ctx, s.si, s.wo, smooth)
            f_em_grad, f_grad = tangents(f_em, f)
        L = s.emission + dr.select(s.sees_emitter, dr.detach(f_em) * s.from_emitter, 0)
        dL = self.β_grad * L + dr.select(s.sees_emitter, s.β * f_em_grad * s.from_emitter, 0)
        self.dL += dr.select(active, dL, 0)
        own = dr.select(smooth, s.β * f_grad * s.inv_pdf, 0)
        self.β_grad = dr.select(active, self.β_grad * s.weight + own, self.β_grad)
