"""Bump and normal maps whose shading ends in a step where light grazes the surface.

A bent normal may face light that comes from below the surface's own horizon. Mitsuba cuts that off, and by default has
what is sent fade out before it (`use_shadowing_function`) [Mitsuba 3.9.1, `normalmap_helpers.h`]. Without, it steps:
where the horizon of a surface moves over a light, or a terminator over a surface. No edge stands for that.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory
from ..core.upload import uploaded
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .bent_normals import BentMap, bent_maps
from .facts import SceneFacts
from .names import plugin_name

#: Cosines of light close above the horizon, and clearly above it.
GRAZING, ABOVE = 1e-4, 0.05

#: Share of what is sent by light clearly above the horizon that is still sent by light close above it: with the
#: function less than a hundredth, without a third and more.
LEFT = 0.1

#: Where spectral variants look [nm].
GREEN = 550.0

#: Places of a map that are looked at (along a side), sines by which normals are bent where it counts, and the sine that
#: is made the median slope of a bump map: it has that of the surface, which need not be known.
SIDE, SINES, MEDIAN_SINE = 24, (0.02, 0.6), 0.2


def warn_about_terminators(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> None:
    """Name shapes with such maps, once each, if anything moves."""
    if not facts.geometry_moves:
        return
    shapes = scene.shapes()
    for shape in facts.shapes:
        if shape.index < 0 or not shape.sees_frame:
            continue
        for bent in bent_maps(shapes[shape.index].bsdf()):
            if ends_in_a_step(bent):
                warn_once(
                    f"the {plugin_name(bent.node)} of shape '{shape.name}' does not fade out what it sends where light "
                    "grazes the surface (use_shadowing_function is off): that steps, and this part of the derivative "
                    "is missing, up to a tenth of it; leave use_shadowing_function on",
                    UnsupportedWarning, memory,
                )  # fmt: skip


def ends_in_a_step(bent: BentMap) -> bool:
    """Does it send light from close above the horizon, towards which it is bent? False where it hardly bends."""
    si = dr.zeros(mi.SurfaceInteraction3f, SIDE**2)
    place = (np.arange(SIDE) + 0.5) / SIDE
    u, v = np.meshgrid(place, place)
    si.uv = mi.Point2f(uploaded(mi.Float, u), uploaded(mi.Float, v))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(GREEN)
    si.n, si.sh_frame, si.wi = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0, 1)
    with dr.suspend_grad():
        size = _median_slope(bent, si) / MEDIAN_SINE
        si.dp_du, si.dp_dv = size * mi.Vector3f(1, 0, 0), size * mi.Vector3f(0, 1, 0)
        n = bent.normal(si, mi.Bool(True))
        sine = dr.norm(mi.Vector2f(n.x, n.y))
        counts = (sine > SINES[0]) & (sine < SINES[1]) & (n.z > 0)
        towards = dr.select(counts, mi.Vector2f(n.x, n.y) / sine, 0)
        low, high = (_sent(bent, si, towards, cos, counts) for cos in (GRAZING, ABOVE))
    return low > LEFT * high


def _median_slope(bent: BentMap, si: mi.SurfaceInteraction3f) -> float:
    """Of a bump map, by texture coordinates; a normal map has none."""
    if plugin_name(bent.node) != "bumpmap":
        return MEDIAN_SINE
    slope = np.array(dr.norm(bent.texture.eval_1_grad(si, mi.Bool(True)))) * abs(mi.traverse(bent.node)["scale"])
    return float(np.median(slope)) or MEDIAN_SINE


def _sent(bent: BentMap, si: mi.SurfaceInteraction3f, towards: mi.Vector2f, cos: float, counts: mi.Bool) -> float:
    """Of light that comes at this cosine, summed."""
    across = towards * np.sqrt(1 - cos**2)
    value = bent.node.eval(mi.BSDFContext(), si, mi.Vector3f(across.x, across.y, cos), counts)
    value = dr.select(counts, mi.unpolarized_spectrum(value), 0)
    return float(np.array(dr.sum(dr.mean(value))).ravel()[0])
