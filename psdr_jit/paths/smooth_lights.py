"""What light of smooth-shaded meshes amounts to in Mitsuba's images.

Mitsuba draws a point y of such a light uniformly, and takes its density per solid angle from the shading normal n_s,

    p_e = r² / (A |n_s·ω|),    that is the true one, with the normal n_g of the face, over ρ = |n_s·ω| / |n_g·ω|.

A sample brings L_e f / p_e, which is expected to be L_e f |n_s·ω| dA/r²; a ray that meets the light by itself brings
L_e f |n_g·ω| dA/r². Under the weights of the power heuristic the image has

    ∫ L_e f R dω,    R = (p_b² + ρ p_e²) / (p_b² + p_e²),

p_b the BSDF's own density of ω [Mitsuba 3.9.1, `path`, `Mesh::sample_position`, `Shape::pdf_direction`]. R is 1 for all
other lights. As soon as anything moves R changes, and with it the weights, whose sum matters where ρ is not 1.

ρ is large where a face is seen edge-on. Both ways to find y have the integrand L_e f R here, and they share it by their
true densities: those of the walk, p_e and what it mixes with p_b, are off by ρ, so that the ray's part would be R in
square over all edge-on directions, which is infinite.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..scene.facts import SceneFacts
from .edge_on import GRAZING_FLAT


def has_smooth_lights(facts: SceneFacts) -> bool:
    """Is some area light a mesh with interpolated normals?"""
    return any(shape.is_emitter and shape.smooth for shape in facts.shapes)


@dataclass(frozen=True)
class SmoothLights:
    """Of scenes with smooth-shaded area lights. Host object.

    `alone`: no light subpaths take a share of what both ways find.
    """

    scene: mi.Scene
    alone: bool

    def of_sample(self, si, bsdf: mi.BSDFPtr, light, ω: mi.Vector3f, mis: mi.Float, active: mi.Bool) -> mi.Float:
        """Factor on what an emitter sample brings from `light` (a surface interaction), with the weight `mis`.

        As attached as `si`, `light` and the direction ω between them; 1 for other lights and where seen edge-on.
        """
        R, ρ = share(self.scene, si, bsdf, light, ω, active)
        ρ = dr.detach(ρ)
        return shared_by_sample(R, ρ, mis) if self.alone else R / ρ

    def of_ray(self, si, bsdf: mi.BSDFPtr, light, ω: mi.Vector3f, mis: mi.Float, active: mi.Bool) -> mi.Float:
        """The same for what a sampled direction meets."""
        R, ρ = share(self.scene, si, bsdf, light, ω, active)
        ρ2 = dr.square(dr.detach(ρ))
        return R / (mis + (1 - mis) * ρ2) if self.alone else R


def share(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, light, ω: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """`(R, ρ)` of what `si` gets from `light` (a surface interaction) along ω and sends on towards its wi.

    As attached as its arguments; 1 for other lights and where the light is seen edge-on.
    """
    n_s, n_g = dr.abs_dot(light.sh_frame.n, ω), dr.abs_dot(light.n, ω)
    usable = active & light.is_valid() & (n_g > GRAZING_FLAT) & (n_s > GRAZING_FLAT)
    ρ = dr.select(usable, n_s / n_g, 1)
    e2 = dr.square(pdf_of_sample(scene, si, light, ω, usable))
    b2 = dr.square(bsdf.pdf(mi.BSDFContext(), si, si.to_local(ω), usable))
    usable &= b2 + e2 > 0
    return dr.select(usable, (b2 + ρ * e2) / dr.select(usable, b2 + e2, 1), 1), ρ


def shared_by_sample(R: mi.Float, ρ: mi.Float, mis: mi.Float) -> mi.Float:
    """The part of R that a light sample with the weight `mis` brings, by true densities."""
    # in this order: the sum is ρ² where the weight is 1, and no less however small that is
    return R * ρ / ((1 - mis) + mis * dr.square(ρ))


def pdf_of_sample(scene: mi.Scene, it: mi.Interaction3f, light, ω: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """p_e of the point `light` as Mitsuba has it, attached but for the area of the light."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.uv, ds.d = light.p, light.sh_frame.n, light.uv, ω
    ds.dist = dr.select(active, dr.norm(light.p - it.p), 1)
    ds.emitter = light.emitter(scene, active)
    return scene.pdf_emitter_direction(it, ds, active)
