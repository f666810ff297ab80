"""Walks that only look: which paths meet something differentiable, and how long do paths get?

They go by the same steps (`bounce.py`) with the same random numbers as `walk.walk`, so they follow the same paths,
without emitters and shadow rays.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core.surface_code import top_level
from .bounce import PathLimits, PathState, bounce
from .rays import first_hit, interaction


def touches(
    scene: mi.Scene, sampler, ray: mi.Ray3f, limits: PathLimits, hide_emitters: bool, table: mi.UInt32
) -> mi.Bool:
    """Does the path scatter at a shape, or an instance, whose entry in `table` (by registry index) is not 0? Detached.

    The last vertex only emits, and emitters are not in question here, so its ray is never traced.
    """

    def stop(pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Bool:
        return dr.gather(mi.UInt32, table, top_level(pi), active) != 0

    found, _ = _follow(scene, sampler, ray, limits, hide_emitters, stop)
    return found


def count_vertices(scene: mi.Scene, sampler, ray: mi.Ray3f, limits: PathLimits, hide_emitters: bool) -> int:
    """No path that `walk` would trace has more vertices than this, and one may have as many (evaluates)."""
    _, scattered = _follow(scene, sampler, ray, limits, hide_emitters, lambda pi, active: mi.Bool(False))
    return int(dr.max(scattered)[0]) + 1


@dr.syntax
def _follow(
    scene: mi.Scene,
    sampler,
    ray: mi.Ray3f,
    limits: PathLimits,
    hide_emitters: bool,
    stop: Callable[[mi.PreliminaryIntersection3f, mi.Bool], mi.Bool],
) -> tuple[mi.Bool, mi.UInt32]:
    """Follow the paths until `stop` has seen enough: `(stopped, number of vertices at which the path scattered)`."""
    ray, pi, _emission = first_hit(scene, ray, hide_emitters)
    ctx = mi.BSDFContext()
    path = PathState.start()
    stopped = mi.Bool(False)
    active = pi.is_valid() & (path.k + 1 < limits.max_depth)
    while dr.hint(active, label="psdr.dry_walk", exclude=[limits]):
        stopped |= stop(pi, active)
        si = interaction(pi, ray, limits)
        sampler.next_2d()  # spent on emitter sampling in `walk`
        onward = bounce(si, si.bsdf(), sampler, path, limits, ctx, active)
        path = onward.path
        ray = onward.ray(si)
        active = onward.alive & ~stopped & (path.k + 1 < limits.max_depth)
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
    return stopped, path.k
