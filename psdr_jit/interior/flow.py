"""How the vertices of a path move while θ changes: the contract of a flow, and what several flows share.

Vertex k sends back to its predecessor

    Lo_k = L_k + w_k · Lo_{k+1}

and hands on an attached point x_k and direction d_k, from which vertex k+1 is reached. A flow decides what x_k and d_k
do: slide along the ray (`spatial.py`), stay on the material (`material.py`), or nothing at all (`resting.py`). The
sweeps carry the derivatives of both, and know nothing else about it.

Where a direction was drawn from a smooth density, its d_k is a constant: the flow keeps the sample. At a specular
vertex d_k follows from the arrival (spatial flow), and the same sweeps carry it.

Emission is in *material* form wherever geometry moves, whether the emitter point y was found by emitter or by BSDF
sampling (both MIS partners estimate one integral, so they must move y alike):

    f(ω_y) · L_e(y→x_k) · G(x_k, y) |dA(y)/dA_0| / p

An area light's outline then is no discontinuity of this term. Infinitely distant emitters keep the direction, and so do
area lights that touch what they shine on (`edges/followed_lights.py`); delta emitters follow their own attached pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Arrival, EmitterSample, Hit, Place, Vertex
from ..edges.followed_lights import FollowedLights
from ..paths.delta_step import delta_step
from ..paths.edge_on import GRAZING, GRAZING_FLAT, least_cosine
from ..paths.orbits import Orbits
from ..paths.rays import ROUNDING
from ..paths.recording import PathRecords
from ..paths.rough_plastic import RoughPlastic, eval_attached
from ..paths.smooth_lights import SmoothLights
from ..plan.motion import Displacements
from ..scene.surfaces import Surfaces


@dataclass
class VertexTerms:
    """Attached terms of one vertex (see the module's equations)."""

    x: mi.Point3f  # the vertex
    d: mi.Vector3f  # direction in which the next one is reached
    L: mi.Spectrum  # direct light scattered at x (both MIS partners), plus emission if it is the first vertex
    w: mi.Spectrum  # factor on what arrives from the next vertex


@dataclass(frozen=True)
class SceneTraits:
    """Which code paths a scene needs at all (fixed while tracing)."""

    delta_emitters: bool
    delta_lobes: bool  # where geometry moves, only the spatial flow follows them
    smooth_lights: SmoothLights | None  # if there are any
    surfaces: Surfaces | None = None  # that Mitsuba does not evaluate
    followed: FollowedLights | None = None  # lights whose emission follows directions (spatial flow only)
    lights_rest: bool = False  # area lights stay where they are, and as large
    orbits: Orbits | None = None  # spheres that carry directions along (spatial flow only)
    rough_plastic: RoughPlastic | None = None  # whose tables depend on a parameter

    def scattered(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, ω: mi.Vector3f, active: mi.Bool
    ) -> mi.Spectrum:
        """f cosθ of light that leaves in the direction ω (world), attached to all that it depends on."""
        return eval_attached(self.rough_plastic, si, bsdf, si.to_local(ω), active)


class Flow(ABC):
    """Host object of a job: the terms of a vertex as a function of how it is reached."""

    def vertices(self, records: PathRecords) -> mi.UInt32:
        """How many vertices of every path have terms: one less if those of the last are certainly 0."""
        return records.count

    @abstractmethod
    def terms(
        self, vertex: Vertex, following: Arrival, ray: mi.Ray3f, at: Place, moves: Displacements
    ) -> VertexTerms:
        """Terms of `vertex`, reached along the attached `ray`; `following` is where the sampled direction leads.

        `at`: which of its path's vertices it is. Called where displacements are attached.
        """


def material_segment(
    x: mi.Point3f,
    hit: Hit,
    wavelengths,
    moves: Displacements,
    active: mi.Bool,
    rests: bool = False,
    flat: float = GRAZING,
):
    """From the attached point `x` to the material point `hit`: `(si, ω, measure)`, all attached.

    `measure` = [G |dA|] / detach(G |dA|), G = |cosθ_y| / r² [Zhang et al. 2020, Eq. 6]; where `hit` escaped, or is x
    itself, the direction stays as it is. `rests`: the point and |dA| are known to rest, which spares the way back to
    vertices. `flat`: cosine below which triangles are taken to be seen edge-on.
    """
    ray = mi.Ray3f(dr.detach(x), hit.d, 0, wavelengths)
    with dr.suspend_grad(when=rests):
        si = moves.material(hit, ray, active)
    on_surface = active & si.is_valid()
    offset = si.p - x
    dist2 = dr.squared_norm(offset)
    # Lights sample themselves: what is no farther than positions are rounded has no direction.
    on_surface &= dist2 > dr.square(ROUNDING * dr.max(dr.abs(dr.detach(x))))
    dist2 = dr.select(on_surface, dist2, 1)
    ω = mi.Vector3f(hit.d)
    ω = dr.select(on_surface, dr.replace_grad(ω, offset * dr.rsqrt(dist2)), ω)
    area = mi.Float(1) if rests else _area_element(si, on_surface)
    cos = dr.abs_dot(si.n, ω)
    # A light or surface seen edge-on changes by 1/cosθ, and its cosine is rounding: see `GRAZING`.
    usable = on_surface & (cos > least_cosine(si.shape, flat)) & (area > 0)
    measure = dr.select(usable, cos / dist2 * area, 1)
    return si, ω, dr.relative_grad(measure)


def emission_towards(
    x: mi.Point3f, hit: Hit, wavelengths, emitter: mi.EmitterPtr, moves: Displacements, active: mi.Bool, rests: bool
):
    """Emission of the material point `hit` towards the attached point `x`: `(point, ω, L_e · measure)`, attached.

    `rests`: `SceneTraits.lights_rest`.
    """
    # What a light sends goes by cosθ, which makes up for 1/cosθ.
    si, ω, measure = material_segment(x, hit, wavelengths, moves, active, rests, GRAZING_FLAT)
    return si, ω, emitter.eval(si, active) * measure


def _area_element(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
    """|dA| of a material point up to a constant factor, attached.

    Meshes: area of the triangle. Their dp_du, dp_dv will not do: a degenerate texture map
    replaces them by a unit frame.
    """
    area = dr.norm(dr.cross(si.dp_du, si.dp_dv))
    on_mesh = active & si.shape.is_mesh()
    mesh = dr.reinterpret_array(mi.MeshPtr, dr.select(on_mesh, dr.reinterpret_array(mi.UInt32, si.shape), 0))
    corners = mesh.face_indices(si.prim_index, on_mesh)
    p0, p1, p2 = (mesh.vertex_position(corners[i], on_mesh) for i in range(3))
    return dr.select(on_mesh, dr.norm(dr.cross(p1 - p0, p2 - p0)), area)


def next_event(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, nee: EmitterSample, traits: SceneTraits, moves: Displacements
) -> mi.Spectrum:
    """Scattered emitter sample, attached: f(ω) · value · MIS / pdf."""
    active = nee.emitter != 0
    emitter = dr.reinterpret_array(mi.EmitterPtr, nee.emitter)
    hit, resting = nee.hit(dr.detach(si.p)), active
    if traits.followed is not None:
        along = active & traits.followed.has(emitter, active)
        resting = active & ~along
    light, ω, value = emission_towards(si.p, hit, si.wavelengths, emitter, moves, resting, traits.lights_rest)
    if traits.smooth_lights is not None:
        value *= traits.smooth_lights.of_sample(si, bsdf, light, ω, nee.mis, resting)
    if traits.delta_emitters:
        is_delta = active & nee.delta
        seen = mi.SurfaceInteraction3f(si)
        seen.p = seen.p - moves.of_lights()
        ds, value_delta = emitter.sample_direction(seen, mi.Point2f(0.5), is_delta)
        ω = dr.select(is_delta, ds.d, ω)
        value = dr.select(is_delta, value_delta, value)
    if traits.followed is not None:
        met = moves.surface(hit, mi.Ray3f(si.p, hit.d, 0, si.wavelengths), mi.RayFlags.All)
        value = dr.select(along, emitter.eval(met, along), value)
    return dr.select(active, traits.scattered(si, bsdf, ω, active) * value * nee.mis_over_pdf(), 0)


def emitter_behind(scene: mi.Scene, following: Arrival, si, active: mi.Bool) -> tuple[mi.EmitterPtr, mi.Bool]:
    """The emitter where the sampled direction leads, `si` or the sky, and the lanes in which its emission counts."""
    emitter = dr.select(si.is_valid(), si.shape.emitter(), scene.environment())
    return emitter, active & (following.weight_emission > 0) & (emitter != None)  # noqa: E711 (an array comparison)


def delta_factor(vertex: Vertex, following: Arrival, si, bsdf: mi.BSDFPtr) -> mi.Spectrum:
    """Factor w of a delta lobe whose direction rests, attached to what the lobe is worth.

    Its value is the ratio of recorded throughputs, also of lobes that a direction does not tell from each other. In
    channels that are black by then there is no such ratio, but there may be a derivative before them.
    """
    delta = vertex.onward.delta
    w = delta_step(mi.BSDFContext(), si, bsdf, following.hit.d, delta).value * vertex.onward.inv_pdf()
    return dr.select(vertex.β != 0, dr.replace_grad(dr.detach(following.β / vertex.β), w), w)
