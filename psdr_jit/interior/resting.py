"""No flow at all: what is emitted and reflected depends on θ, but no path, direction or measure does.

Emission then counts where it is met, as in a primal path tracer, and delta lobes keep their directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, Place, Vertex
from ..paths.surface_at import surface_at
from ..plan.motion import Displacements
from .flow import Flow, SceneTraits, VertexTerms, delta_factor


@dataclass(frozen=True)
class RestingFlow(Flow):
    """See the module."""

    scene: mi.Scene
    traits: SceneTraits

    def terms(
        self, vertex: Vertex, following: Arrival, ray: mi.Ray3f, at: Place, moves: Displacements
    ) -> VertexTerms:
        si = surface_at(self.traits.surfaces, vertex.hit.intersection(), ray, mi.RayFlags.All)
        bsdf = si.bsdf()
        emits = vertex.weight_emission > 0
        L = dr.select(emits, vertex.weight_emission * si.emitter(self.scene).eval(si, emits), 0)
        L += self._next_event(si, bsdf, vertex)
        goes_on = vertex.onward.goes_on()
        w = self.traits.scattered(si, bsdf, following.hit.d, goes_on) * vertex.onward.inv_pdf()
        if self.traits.delta_lobes:
            w = dr.select(vertex.onward.delta, delta_factor(vertex, following, si, bsdf), w)
        return VertexTerms(si.p, following.hit.d, L, w)

    def _next_event(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, vertex: Vertex) -> mi.Spectrum:
        """Scattered emitter sample, attached: f(ω) · value · MIS / pdf."""
        nee, active = vertex.nee, vertex.nee.emitter != 0
        emitter = dr.reinterpret_array(mi.EmitterPtr, nee.emitter)
        ray = mi.Ray3f(si.p, nee.d, 0, si.wavelengths)
        source = surface_at(self.traits.surfaces, nee.hit(si.p).intersection(), ray, mi.RayFlags.All, active)
        value = emitter.eval(source, active)
        if self.traits.delta_emitters:
            is_delta = active & nee.delta
            _, value_delta = emitter.sample_direction(si, mi.Point2f(0.5), is_delta)
            value = dr.select(is_delta, value_delta, value)
        return dr.select(active, self.traits.scattered(si, bsdf, nee.d, active) * value * nee.mis_over_pdf(), 0)
