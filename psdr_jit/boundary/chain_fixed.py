"""What all chains of a line across the film have in common: directions, random numbers, and points of light.

The spatial form keeps the directions in which smooth vertices are left, and points of light on their material
(`interior/spatial.py`). Its integrand is a function of the film point, for given directions and points of light, and it
is that function whose steps are looked for. So both must be drawn without regard to where on the line a chain begins:

    direction     from a mixture of equal parts of what the surface prefers that a chain from a random point of the
                  line (the *guide*) meets there, and of the whole sphere; half of them aimed from there (`chain_aims`)
                  if there is something to aim at; where the guide has ended, the sphere alone
    light point   on an emitter by its area, or as a direction to the sky

The share of the sphere bounds the weights of chains that meet another surface than the guide does.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.varying import varying
from ..paths.rays import shadow_hit
from .chain_aims import ChainAims

#: Share of directions that are drawn from the whole sphere, of those that are not aimed.
SPHERE_SHARE = 0.5

#: Share of directions that are aimed, where there is something to aim at; the others are drawn as without.
AIMED_SHARE = 0.5


@dataclass
class Direction:
    """In which a smooth vertex is left. Detached."""

    ω: mi.Vector3f  # unit, world space
    pdf: mi.Float  # per solid angle [1/sr]; 0: the path ends


class Directions:
    """Those of the first `depth` vertices of `lines`, vertex-major. Not a PyTree, so never loop state."""

    BYTES = 16  # of one vertex

    def __init__(self, lines: int, depth: int):
        self.stride = varying(mi.UInt32, lines)
        n = lines * depth
        self.data = Direction(dr.zeros(mi.Vector3f, n), dr.zeros(mi.Float, n))
        dr.make_opaque(self.data)

    def write(self, k: mi.UInt32, line: mi.UInt32, direction: Direction) -> None:
        dr.scatter(self.data, direction, k * self.stride + line, mode=dr.ReduceMode.Permute)

    def read(self, k: mi.UInt32, line: mi.UInt32, active: mi.Bool) -> Direction:
        return dr.gather(Direction, self.data, k * self.stride + line, active)


def draw_direction(si: mi.SurfaceInteraction3f, sampler, smooth: mi.Bool, aims: ChainAims | None) -> Direction:
    """Of the guide's vertex `si`, which is left by a `smooth` lobe; elsewhere from the whole sphere."""
    u_share, u_lobe, u = sampler.next_1d(), sampler.next_1d(), sampler.next_2d()
    ω, ctx, bsdf = mi.warp.square_to_uniform_sphere(u), mi.BSDFContext(), si.bsdf()
    aimed, cones = mi.Bool(False), None
    if aims is not None:
        cones = aims.seen_from(si.p)
        q = dr.select(smooth & (cones.total > 0), AIMED_SHARE, mi.Float(0))
        aimed = u_share < q
        u_share = dr.select(aimed, 0, (u_share - q) / (1 - q))
    preferred = smooth & (u_share >= SPHERE_SHARE)
    bs, _ = bsdf.sample(ctx, si, u_lobe, u, preferred)
    wasted = preferred & ((bs.pdf == 0) | mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
    ω = dr.select(preferred, si.to_world(bs.wo), ω)
    if aims is not None:
        ω = dr.select(aimed, cones.sample(u), ω)
    pdf = SPHERE_SHARE * dr.inv_four_pi + (1 - SPHERE_SHARE) * bsdf.pdf(ctx, si, si.to_local(ω), smooth)
    if aims is not None:
        pdf = q * cones.pdf(ω) + (1 - q) * pdf
    return Direction(ω, dr.select(wasted, 0, dr.select(smooth, pdf, dr.inv_four_pi)))


@dataclass
class LightPoint:
    """A point of light, whatever it lights. Detached."""

    emitter: mi.UInt32  # registry index
    x: mi.Point3f  # of an area light
    u: mi.Point2f  # random numbers that tell where others are
    weight: mi.Float  # 1 / (probability of the emitter · density by area, where it has one)

    def pointer(self) -> mi.EmitterPtr:
        return dr.reinterpret_array(mi.EmitterPtr, self.emitter)

    def towards(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """How it is seen from `si`, and the radiance over the density of what is no area light."""
        emitter = self.pointer()
        on_surface = mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        ds, value = emitter.sample_direction(si, self.u, active & ~on_surface)
        offset = self.x - si.p
        dist = dr.norm(offset)
        ds.p = dr.select(on_surface, self.x, ds.p)
        ds.dist = dr.select(on_surface, dist, ds.dist)
        ds.d = dr.select(on_surface, offset / dist, ds.d)
        ds.emitter = emitter
        return ds, dr.select(on_surface, 0, value)

    def seen_from(self, scene: mi.Scene, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[Hit, mi.Bool]:
        """Where the shadow ray from `si` ends, and whether that is at this point."""
        return shadow_hit(scene, si, self.towards(si, active)[0], active)

    def scattered(self, si: mi.SurfaceInteraction3f, seen: tuple, source: Hit, active: mi.Bool) -> mi.Spectrum:
        """What `si` scatters of it, over its density. `seen`: of `towards`; `source`: the end of an unblocked ray."""
        emitter, (ds, value) = self.pointer(), seen
        ray = mi.Ray3f(source.o, source.d, 0, si.wavelengths)
        light = source.intersection().compute_surface_interaction(ray, mi.RayFlags.All, active)
        on_surface = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        # Mitsuba weighs samples of a smooth-shaded light as if its faces were turned as its shading normals are.
        cos = dr.abs_dot(light.sh_frame.n, ds.d)
        value = dr.select(on_surface, emitter.eval(light, on_surface) * cos / dr.square(ds.dist), value)
        return si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), active) * value * self.weight


def draw_light(scene: mi.Scene, u: mi.Float, u_point: mi.Point2f, active: mi.Bool) -> LightPoint:
    """An emitter, and a point on it."""
    index, weight, _ = scene.sample_emitter(u, active)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
    on_surface = active & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    ps, over_pdf = emitter.sample_position(0, u_point, on_surface)
    weight = weight * dr.select(on_surface, over_pdf, 1)
    return LightPoint(dr.reinterpret_array(mi.UInt32, emitter), mi.Point3f(ps.p), mi.Point2f(u_point), weight)
