"""The *mixed* flow: vertices stay on their material, but for those after a vertex with another surface close by.

With w_k = 1 where the vertex after x_k slides along its ray (`spatial.py`) and 0 where it stays where it is
(`material.py`), the direction in which x_k is left moves by

    ω̇_k = (1 − w_k) · m(ω_k),        m = (v_{k+1} − u_k), at right angles to ω_k, over |x_{k+1} − x_k|

w_k is a function of x_k alone, and of the side of the surface on which ω_k lies. The divergence of the flow has the
derivatives ∂ω̇_k/∂ω_k only, so that none of w_k occurs in it; nor is the step of w_k between two places x_k a boundary,
as ω̇_k does not cross it, nor that between both sides, where f·cosθ is 0. Hence the terms of the interior are those of
the one form or of the other, vertex by vertex, and boundary segments at the receiver x_k as well (`boundary/indirect`).
Motion is carried from x_k on to a vertex that slides, and ends at one that does not.

In corners and contacts the material form has kernels 1/|x_{k+1} − x_k|, of which neither variance nor, where two
surfaces move against each other, the integral itself is finite; elsewhere the spatial one slides over textures and at
slants, by 1/cosθ. The two weaknesses are in different places (`paths/close_by.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, Place, Vertex
from .material import MaterialFlow


@dataclass(frozen=True)
class MixedFlow(MaterialFlow):
    """See the module. Of records that know what is close by (`PathRecords.note_close_by`)."""

    def _slides(self, at: Place) -> mi.Bool:
        return at.first | at.slides

    def _onward(
        self,
        w: mi.Spectrum,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        vertex: Vertex,
        following: Arrival,
        at: Place,
    ) -> mi.Spectrum:
        goes_on = vertex.onward.goes_on()
        along = self.traits.scattered(si, bsdf, following.hit.d, goes_on) * vertex.onward.inv_pdf()
        return dr.select(at.slides_next, along, w)
