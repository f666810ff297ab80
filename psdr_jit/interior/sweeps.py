"""Interior term in *spatial* form: the derivative of every path's contribution while its directions stay fixed.

A path x_1, …, x_N leaves the sensor along ray 1; every later ray keeps its direction ω_k while the parameter
θ changes, so each vertex slides along the ray that reaches it:

    u_{k+1} = u_k − ω_k · n·(u_k − v_{k+1}) / (n·ω_k)                                    (motion transport)

with v the material velocity of the surface and u_1 given by the attached camera ray. This is the "original"
parameterisation of [Zhang et al. 2020, §4, Eq. 14-17]; differentiating Mitsuba's ray-triangle intersection with an
attached origin produces exactly this recursion. The contribution of vertex k then is

    L_k = f(ω_y) · L_e(y→x_k) · G(x_k, y) |dA(y)/dA_0| / p                             (emitter point y: material form)
        + w_k · L_{k+1},       w_k = f(ω_{k+1}) / p                                   (continuation: direction fixed)

Emission is in *material* form whether y was found by emitter or by BSDF sampling (both MIS partners estimate one
integral, so they must move y alike): an area light's outline then is no discontinuity of this term. Infinitely
distant emitters keep the direction, delta emitters follow their own attached pose. The visibility
discontinuities of this flow are left to the boundary terms.

Forward mode walks away from the sensor carrying tangents (ȯ, β̇); backward mode walks back towards it carrying the
adjoint of the ray origin and the radiance of the rest of the path. Both replay the same recorded vertices
(`paths/recording.py`) and call the same `vertex_terms`, so they agree to rounding and neither traces a ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import tangents
from ..core.records import Arrival, Hit, Vertex
from ..paths.recording import GRAZING, PathRecords
from ..plan.motion import Displacements, Motion


@dataclass
class VertexTerms:
    """Attached terms of one vertex (see the module's equations)."""

    x: mi.Point3f  # the vertex, sliding along its ray
    L: mi.Spectrum  # direct light scattered at x (both MIS partners), plus emission if it is the first vertex
    w: mi.Spectrum  # factor on what arrives from the next vertex


@dataclass(frozen=True)
class SceneTraits:
    """Which code paths a scene needs at all (fixed while tracing)."""

    delta_emitters: bool
    delta_lobes: bool  # only together with static geometry, see `scene.checks`
    moves: bool  # geometry, a light's pose or the camera depend on θ; otherwise the paths themselves are constants
    form: str = "spatial"  # what vertices do from the second on: slide along their rays, or stay on their material


def _material_segment(x: mi.Point3f, hit: Hit, wavelengths, moves: Displacements, active: mi.Bool):
    """From the attached point `x` to the material point `hit`: `(si, ω, measure)`, all attached.

    `measure` = [G |dA|] / detach(G |dA|), G = |cosθ_y| / r² [Zhang et al. 2020, Eq. 6]; where `hit` escaped the
    direction stays as it is.
    """
    ray = mi.Ray3f(dr.detach(x), hit.d, 0, wavelengths)
    si = hit.intersection().compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    moves.follow(si, hit)
    on_surface = active & si.is_valid()
    offset = si.p - x
    dist2 = dr.squared_norm(offset)
    ω = mi.Vector3f(hit.d)
    ω = dr.select(on_surface, dr.replace_grad(ω, offset * dr.rsqrt(dist2)), ω)
    area = _area_element(si, on_surface)
    cos = dr.abs_dot(si.n, ω)
    # A light or surface seen edge-on changes by 1/cosθ, and its cosine is rounding: see `GRAZING`.
    usable = on_surface & (cos > GRAZING) & (area > 0)
    measure = dr.select(usable, cos / dist2 * area, 1)
    return si, ω, dr.relative_grad(measure)


def _emission_towards(
    x: mi.Point3f, hit: Hit, wavelengths, emitter: mi.EmitterPtr, moves: Displacements, active: mi.Bool
):
    """Emission of the material point `hit` towards the attached point `x`: `(ω, L_e · measure)`, both attached."""
    si, ω, measure = _material_segment(x, hit, wavelengths, moves, active)
    return ω, emitter.eval(si, active) * measure


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


def _next_event(si, bsdf, nee, traits: SceneTraits, moves: Displacements):
    """Scattered emitter sample, attached: f(ω) · value · weight."""
    active = nee.emitter != 0
    emitter = dr.reinterpret_array(mi.EmitterPtr, nee.emitter)
    ω, value = _emission_towards(si.p, nee.hit(dr.detach(si.p)), si.wavelengths, emitter, moves, active)
    if traits.delta_emitters:
        is_delta = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        seen = mi.SurfaceInteraction3f(si)
        seen.p = seen.p - moves.of_lights()
        ds, value_delta = emitter.sample_direction(seen, mi.Point2f(0.5), is_delta)
        ω = dr.select(is_delta, ds.d, ω)
        value = dr.select(is_delta, value_delta, value)
    f = bsdf.eval(mi.BSDFContext(), si, si.to_local(ω), active)
    return dr.select(active, f * value * nee.weight, 0)


def _terms_of_resting(scene: mi.Scene, vertex: Vertex, following: Arrival, ray: mi.Ray3f, traits: SceneTraits):
    """`vertex_terms` where no path changes: what is emitted and reflected depends on θ, directions and measures do not.

    Emission then counts where it is met, as in a primal path tracer.
    """
    ctx = mi.BSDFContext()
    si = vertex.hit.intersection().compute_surface_interaction(ray, mi.RayFlags.All)
    bsdf = si.bsdf()
    emits = vertex.weight_emission > 0
    L = dr.select(emits, vertex.weight_emission * si.emitter(scene).eval(si, emits), 0)

    nee, active = vertex.nee, vertex.nee.emitter != 0
    emitter = dr.reinterpret_array(mi.EmitterPtr, nee.emitter)
    source_ray = mi.Ray3f(si.p, nee.d, 0, ray.wavelengths)
    source = nee.hit(si.p).intersection().compute_surface_interaction(source_ray, mi.RayFlags.All, active)
    value = emitter.eval(source, active)
    if traits.delta_emitters:
        is_delta = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        _, value_delta = emitter.sample_direction(si, mi.Point2f(0.5), is_delta)
        value = dr.select(is_delta, value_delta, value)
    L += dr.select(active, bsdf.eval(ctx, si, si.to_local(nee.d), active) * value * nee.weight, 0)

    goes_on = vertex.inv_pdf != 0
    w = bsdf.eval(ctx, si, si.to_local(following.hit.d), goes_on) * dr.abs(vertex.inv_pdf)
    if traits.delta_lobes:
        w = dr.select(vertex.inv_pdf < 0, _throughput_ratio(vertex, following), w)
    return VertexTerms(si.p, L, w)


def _terms_on_material(
    scene: mi.Scene, vertex: Vertex, following: Arrival, ray: mi.Ray3f, first, traits: SceneTraits, moves: Displacements
):
    """`vertex_terms` in material form: every vertex but the first stays where it is on its surface.

    `ray` starts at the attached predecessor. Seen from there the vertex is met by a ray that moves along with it, so
    that Mitsuba's own intersection yields the attached frame and texture coordinates of the same material point.
    """
    ctx = mi.BSDFContext()
    along = mi.Ray3f(ray)
    material = moves.material_point(vertex.hit, ray.wavelengths)
    along.o = dr.select(first, ray.o, dr.replace_grad(vertex.hit.o, material))
    along.d = dr.select(first, ray.d, vertex.hit.d)
    si = moves.surface(vertex.hit, along, mi.RayFlags.All)
    arrival = dr.replace_grad(vertex.hit.d, dr.normalize(si.p - ray.o))
    si.wi = dr.select(first | ~si.is_valid(), si.wi, si.to_local(-arrival))
    L = dr.select(first, vertex.weight_emission * si.emitter(scene).eval(si, first), 0)
    bsdf = si.bsdf()
    L += _next_event(si, bsdf, vertex.nee, traits, moves)

    goes_on = vertex.inv_pdf != 0
    onward, ω, measure = _material_segment(si.p, following.hit, si.wavelengths, moves, goes_on)
    w = bsdf.eval(ctx, si, si.to_local(ω), goes_on) * measure * dr.abs(vertex.inv_pdf)
    emitter = dr.select(onward.is_valid(), onward.shape.emitter(), scene.environment())
    emits = goes_on & (following.weight_emission > 0) & (emitter != None)  # noqa: E711 (an array comparison)
    L += dr.select(emits, w * emitter.eval(onward, emits) * following.weight_emission, 0)
    return VertexTerms(si.p, L, w)


def _throughput_ratio(vertex: Vertex, following: Arrival) -> mi.Spectrum:
    """Weight of a delta lobe, which has no value to evaluate: a constant here."""
    return dr.select(vertex.β != 0, following.β / vertex.β, 0)


def vertex_terms(
    scene: mi.Scene, vertex: Vertex, following: Arrival, ray: mi.Ray3f, first, traits: SceneTraits, moves: Displacements
):
    """Terms of `vertex`, reached along the attached `ray`; `following` is where the sampled direction leads."""
    if not traits.moves:
        return _terms_of_resting(scene, vertex, following, ray, traits)
    if traits.form == "material":
        return _terms_on_material(scene, vertex, following, ray, first, traits, moves)
    ctx = mi.BSDFContext()
    si = moves.surface(vertex.hit, ray, mi.RayFlags.All)
    L = dr.select(first, vertex.weight_emission * si.emitter(scene).eval(si, first), 0)

    bsdf = si.bsdf()
    L += _next_event(si, bsdf, vertex.nee, traits, moves)

    goes_on = vertex.inv_pdf != 0
    inv_pdf = dr.abs(vertex.inv_pdf)
    w = bsdf.eval(ctx, si, si.to_local(following.hit.d), goes_on) * inv_pdf

    found = following.hit.intersection()
    emitter = dr.select(found.is_valid(), found.shape.emitter(), scene.environment())
    emits = goes_on & (following.weight_emission > 0) & (emitter != None)  # noqa: E711 (an array comparison)
    ω, value = _emission_towards(si.p, following.hit, si.wavelengths, emitter, moves, emits)
    w_emission = bsdf.eval(ctx, si, si.to_local(ω), emits) * inv_pdf
    if traits.delta_lobes:
        is_delta, ratio = vertex.inv_pdf < 0, _throughput_ratio(vertex, following)
        w, w_emission = dr.select(is_delta, ratio, w), dr.select(is_delta, ratio, w_emission)
    L += dr.select(emits, w_emission * value * following.weight_emission, 0)
    return VertexTerms(si.p, L, w)


@dr.syntax
def backward_sweep(scene: mi.Scene, records: PathRecords, δL: mi.Spectrum, traits: SceneTraits, motion: Motion):
    """Accumulate ⟨δL, dL⟩ into the scene's parameters; returns the adjoints `(λ_o, λ_d)` of the camera rays.

    `δL`: adjoint of each path's radiance, detached.
    """
    k = mi.UInt32(records.count)
    rest = mi.Spectrum(0)  # radiance that the next vertex sends back, without its own emission
    λ_o = mi.Vector3f(0)
    λ_d = mi.Vector3f(0)
    active = k > 0
    while dr.hint(active, label="psdr.interior.backward", exclude=[traits, motion]):
        k -= 1
        v = records.vertex(k, active)
        following = records.arrival(k + 1, active & (v.inv_pdf != 0))
        o, d = mi.Point3f(v.hit.o), mi.Vector3f(v.hit.d)
        with motion.attached(o, d) as moving:
            t = vertex_terms(scene, v, following, mi.Ray3f(o, d, 0, records.wavelengths), k == 0, traits, moving)
            Lo = t.L + t.w * rest
            dr.backward_from(dr.sum(δL * v.β * Lo) + dr.dot(λ_o, t.x))
            λ_o = mi.Vector3f(dr.grad(o))
            λ_d = mi.Vector3f(dr.grad(d))
        rest = dr.detach(Lo)
        active = k > 0
    return λ_o, λ_d


@dr.syntax
def forward_sweep(scene: mi.Scene, records: PathRecords, o_grad, d_grad, traits: SceneTraits, motion: Motion):
    """Derivative of each path's radiance, given the tangents `(ȯ, ḋ)` of its camera ray. Detached result."""
    k = mi.UInt32(0)
    dL = mi.Spectrum(0)
    β_grad = mi.Spectrum(0)
    o_grad = mi.Vector3f(o_grad)
    d_grad = mi.Vector3f(d_grad)
    active = k < records.count
    while dr.hint(active, label="psdr.interior.forward", exclude=[traits, motion]):
        v = records.vertex(k, active)
        following = records.arrival(k + 1, active & (v.inv_pdf != 0))
        o, d = mi.Point3f(v.hit.o), mi.Vector3f(v.hit.d)
        with motion.attached(o, d) as moving:
            dr.set_grad(o, o_grad)
            dr.set_grad(d, d_grad)
            ray = mi.Ray3f(o, d, 0, records.wavelengths)
            t = vertex_terms(scene, v, following, ray, k == 0, traits, moving)
            # x is an input of L: keep the gradients of interior nodes until they have been read
            L_grad, w_grad, x_grad = tangents(t.L, t.w, t.x)
        dL += β_grad * dr.detach(t.L) + v.β * L_grad
        β_grad = β_grad * dr.detach(t.w) + v.β * w_grad
        o_grad = mi.Vector3f(x_grad)
        d_grad = mi.Vector3f(0)
        k += 1
        active = k < records.count
    return dL
