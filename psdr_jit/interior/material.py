"""The *material* flow: every vertex but the first stays where it is on its surface.

Directions then change with their end points, and so does the measure:

    w_k = f(ω_{k+1}) · G(x_k, x_{k+1}) |dA_{k+1}/dA_0| / p

[Zhang et al. 2020, Eq. 6]. The first vertex follows the camera ray and slides as in the spatial flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, Place, Vertex
from ..paths.recording import PathRecords
from ..plan.motion import Displacements
from .flow import Flow, SceneTraits, VertexTerms, emitter_behind, material_segment, next_event


@dataclass(frozen=True)
class MaterialFlow(Flow):
    """See the module."""

    scene: mi.Scene
    traits: SceneTraits

    def vertices(self, records: PathRecords) -> mi.UInt32:
        return records.scattering()  # what others than the first emit is among the terms of those before them

    def terms(
        self, vertex: Vertex, following: Arrival, ray: mi.Ray3f, at: Place, moves: Displacements
    ) -> VertexTerms:
        si = _surface(vertex, ray, self._slides(at), moves)
        bsdf = si.bsdf()
        L = dr.select(at.first, vertex.weight_emission * si.emitter(self.scene).eval(si, at.first), 0)
        L += next_event(si, bsdf, vertex.nee, self.traits, moves)

        goes_on = vertex.onward.goes_on()
        behind, ω, measure = material_segment(si.p, following.hit, si.wavelengths, moves, goes_on)
        w = self.traits.scattered(si, bsdf, ω, goes_on) * measure * vertex.onward.inv_pdf()
        emitter, emits = emitter_behind(self.scene, following, behind, goes_on)
        value = emitter.eval(behind, emits)
        if self.traits.smooth_lights is not None:
            value *= self.traits.smooth_lights.of_ray(si, bsdf, behind, ω, following.weight_emission, emits)
        L += dr.select(emits, w * value * following.weight_emission, 0)
        return VertexTerms(si.p, following.hit.d, L, self._onward(w, si, bsdf, vertex, following, at))

    def _slides(self, at: Place) -> mi.Bool:
        """Does the vertex slide along its ray?"""
        return at.first

    def _onward(
        self,
        w: mi.Spectrum,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        vertex: Vertex,
        following: Arrival,
        at: Place,
    ) -> mi.Spectrum:
        """Factor on what arrives from the next vertex; `w`: if that stays where it is."""
        return w


def _surface(vertex: Vertex, ray: mi.Ray3f, slides: mi.Bool, moves: Displacements) -> mi.SurfaceInteraction3f:
    """The attached vertex; `ray` starts at its attached predecessor.

    Unless it `slides` the vertex is met by a ray that moves along with it, so that Mitsuba's own intersection yields
    the attached frame and texture coordinates of the same material point.
    """
    along = mi.Ray3f(ray)
    material = moves.material_point(vertex.hit, ray.wavelengths)
    along.o = dr.select(slides, ray.o, dr.replace_grad(vertex.hit.o, material))
    along.d = dr.select(slides, ray.d, vertex.hit.d)
    si = moves.surface(vertex.hit, along, mi.RayFlags.All)
    arrival = dr.replace_grad(vertex.hit.d, dr.normalize(si.p - ray.o))
    si.wi = dr.select(slides | ~si.is_valid(), si.wi, si.to_local(-arrival))
    return si
