"""Walks that only look: which paths meet something differentiable, and how long do paths get?

They draw the same random numbers in the same order as `walk.walk`, so they follow the same paths.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .scattering import sample_scattering
from .walk import PathLimits, continue_path, first_hit, interaction


@dr.syntax
def touches(
    scene: mi.Scene, sampler, ray: mi.Ray3f, limits: PathLimits, hide_emitters: bool, table: mi.UInt32
) -> mi.Bool:
    """Does the path scatter at a shape whose entry in `table` (by registry index) is not 0? Detached.

    The last vertex only emits, and emitters are not in question here, so its ray is never traced.
    """
    # a frozen dataclass cannot be loop state
    max_depth, rr_depth, end_black = limits.max_depth, limits.rr_depth, limits.end_black
    share, refuses, own_frames = limits.uniform_share, limits.refuses, limits.own_frames
    ray, pi, _emission = first_hit(scene, ray, hide_emitters)
    found = mi.Bool(False)
    β = mi.Spectrum(1)
    η = mi.Float(1)
    k = mi.UInt32(0)
    active = pi.is_valid() & (k + 1 < max_depth)
    while dr.hint(active, label="psdr.touches"):
        found |= dr.gather(mi.UInt32, table, dr.reinterpret_array(mi.UInt32, pi.shape), active) != 0
        si = interaction(pi, ray, own_frames)
        sampler.next_2d()  # spent on emitter sampling in `walk`
        u_lobe, u = sampler.next_1d(), sampler.next_2d()
        bs = sample_scattering(mi.BSDFContext(), si, si.bsdf(), u_lobe, u, share, refuses, active)
        β, η, alive, _weight = continue_path(sampler, β * bs.weight, η * bs.η, k, rr_depth, end_black)
        alive &= bs.pdf > 0
        k += 1
        active = alive & ~found & (k + 1 < max_depth)
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
    return found


@dr.syntax
def count_vertices(scene: mi.Scene, sampler, ray: mi.Ray3f, limits: PathLimits, hide_emitters: bool) -> int:
    """Largest number of vertices among the paths that `walk` would trace (evaluates; unlimited depth only)."""
    rr_depth, end_black, share = limits.rr_depth, limits.end_black, limits.uniform_share
    refuses, own_frames = limits.refuses, limits.own_frames
    ray, pi, _emission = first_hit(scene, ray, hide_emitters)
    β = mi.Spectrum(1)
    η = mi.Float(1)
    k = mi.UInt32(0)
    active = pi.is_valid()
    while dr.hint(active, label="psdr.count_vertices"):
        si = interaction(pi, ray, own_frames)
        sampler.next_2d()
        u_lobe, u = sampler.next_1d(), sampler.next_2d()
        bs = sample_scattering(mi.BSDFContext(), si, si.bsdf(), u_lobe, u, share, refuses, active)
        β, η, active, _weight = continue_path(sampler, β * bs.weight, η * bs.η, k, rr_depth, end_black)
        active &= bs.pdf > 0
        k += 1
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
    return int(dr.max(k)[0]) + 1
