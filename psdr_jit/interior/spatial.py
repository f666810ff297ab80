"""The *spatial* flow: directions stay fixed, and every vertex slides along the ray that reaches it.

    u_{k+1} = u_k − ω_k · n·(u_k − v_{k+1}) / (n·ω_k)                                    (motion transport)

with v the material velocity of the surface and u_1 given by the attached camera ray. This is the "original"
parameterisation of [Zhang et al. 2020, §4, Eq. 14-17]; differentiating Mitsuba's ray-triangle intersection with an
attached origin produces exactly this recursion. The factor of the continuation is w_k = f(ω_{k+1}) / p. The visibility
discontinuities of this flow are left to the boundary terms.

At a delta lobe the direction follows the arrival and the normal (`paths/delta_step.py`), and w_k is the lobe's value
over its probability. Emission that is met there counts where the attached ray meets it, without a measure: no emitter
sample could have found it, and the outline of the light is a discontinuity. So does emission of lights that touch what
they shine on, at smooth lobes (`edges/followed_lights.py`).

Directions towards spheres that are mirrors or glass turn along with them (`paths/orbits.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, Place, Vertex
from ..paths.delta_step import delta_step
from ..paths.recording import PathRecords
from ..plan.motion import Displacements
from .flow import Flow, SceneTraits, VertexTerms, emission_towards, emitter_behind, next_event


@dataclass(frozen=True)
class SpatialFlow(Flow):
    """See the module."""

    scene: mi.Scene
    traits: SceneTraits

    def vertices(self, records: PathRecords) -> mi.UInt32:
        return records.scattering()  # what others than the first emit is among the terms of those before them

    def terms(
        self, vertex: Vertex, following: Arrival, ray: mi.Ray3f, at: Place, moves: Displacements
    ) -> VertexTerms:
        si = moves.surface(vertex.hit, ray, mi.RayFlags.All)
        bsdf = si.bsdf()
        L = dr.select(at.first, vertex.weight_emission * si.emitter(self.scene).eval(si, at.first), 0)
        L += next_event(si, bsdf, vertex.nee, self.traits, moves)

        goes_on, inv_pdf = vertex.onward.goes_on(), vertex.onward.inv_pdf()
        onward, stretch = self._onward(si.p, vertex, following, goes_on, moves)
        w = self.traits.scattered(si, bsdf, onward, goes_on) * stretch * inv_pdf

        emitter, emits = emitter_behind(self.scene, following, following.hit.intersection(), goes_on)
        along = mi.Bool(False) if self.traits.followed is None else self.traits.followed.has(emitter, emits)
        light, ω, value = emission_towards(si.p, following.hit, si.wavelengths, emitter, moves, emits & ~along,
                                           self.traits.lights_rest)  # fmt: skip
        if self.traits.smooth_lights is not None:
            weighed = emits & ~along & ~vertex.onward.delta
            value *= self.traits.smooth_lights.of_ray(si, bsdf, light, ω, following.weight_emission, weighed)
        w_emission = self.traits.scattered(si, bsdf, ω, emits) * inv_pdf
        if self.traits.delta_lobes:
            is_delta = vertex.onward.delta
            step = delta_step(mi.BSDFContext(), si, bsdf, following.hit.d, is_delta)
            onward = dr.select(is_delta, step.d, onward)
            along |= is_delta
            w, w_emission = (dr.select(is_delta, step.value * inv_pdf, smooth) for smooth in (w, w_emission))
        if self.traits.delta_lobes or self.traits.followed is not None:
            ray = mi.Ray3f(si.p, onward, 0, si.wavelengths)
            met = moves.surface(following.hit, ray, mi.RayFlags.All)
            value = dr.select(along, emitter.eval(met, emits & along), value)
        L += dr.select(emits, w_emission * value * following.weight_emission, 0)
        return VertexTerms(si.p, onward, L, w)

    def _onward(
        self, x: mi.Point3f, vertex: Vertex, following: Arrival, active: mi.Bool, moves: Displacements
    ) -> tuple[mi.Vector3f, mi.Float]:
        """Attached direction in which the vertex x is left by a smooth lobe, and what becomes of dω: `(ω, 1)`."""
        ω, orbits = following.hit.d, self.traits.orbits
        if orbits is None:
            return ω, mi.Float(1)
        active = active & ~vertex.onward.delta & ~following.mirrored
        sphere = orbits.seen(dr.detach(x), vertex.hit.shape, ω, following.hit.shape, active)
        of_centre, of_radius = orbits.motion(moves, dr.select(sphere.holds, following.hit.shape, 0))
        δ = of_centre - (x - dr.detach(x))
        return ω + sphere.turn(δ, of_radius), 1 + sphere.stretch(δ, of_radius)
