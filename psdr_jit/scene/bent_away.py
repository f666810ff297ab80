"""Bent normals that turn from the sensor: where they begin to, what a bump or normal map sends there steps.

Mitsuba then turns them over (`flip_invalid_normals`), or the nested BSDF ends. No edge stands for the curves within
texels at which that begins. Maps that are steep for how they are looked at are named where these curves move: with the
shape, with the camera, and with the map itself.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory
from ..core.sensor_frame import sensor_frame
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .delta_lobes import BENT_NORMALS
from .facts import SceneFacts
from .graph import child_objects, plugin_name
from .sight_lines import first_hits, lines_of_sight

#: Share of what is seen of a shape that may be turned away: a sheet with 2 % was 7 % off, a ball with 0.8 % by 9 %.
TURNED_SHARE = 0.005

#: Cosine of the view below which all surfaces, round ones at their rims, show little of themselves.
SLANTED = 0.25

#: Cosine of the view up to which a point is at a rim, and share of what is seen of a shape from which it has one: of a
#: ball 1 %. Faces seen at an angle have none.
AT_RIM, RIM_SHARE = 0.1, 0.003

#: By how much normals at the rim may turn away, as a mean of sines. Gains of balls and rings that were moved: 1.05 and
#: 1.06 at .04 and .03, between 1.01 and 1.03 at .02, up to 1.02 below .01.
TURNED_AT_RIM = 0.01


def warn_about_bent_normals(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Name shapes of which the sensor sees many points whose bent normals turn from it, once each."""
    shapes = scene.shapes()
    all_move = facts.view_moves
    bent = [(s, maps) for s in facts.shapes if s.index >= 0 and (maps := _maps(shapes[s.index].bsdf()))
            and (all_move or s.moves or s.shading or any(map(_changes, maps)))]  # fmt: skip
    if not bent:
        return
    o, d, _, _ = lines_of_sight(scene, sensor_frame(sensor))
    ray, pi, number = first_hits(scene, o, d)
    for shape, maps in bent:
        met = number == shape.index + 1
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, met)
        normals = [_bent(si, node, met) for node in maps]
        share = max(_turned_share(si, n, met) for n in normals)
        if share > TURNED_SHARE:
            warn_once(
                f"the {plugin_name(maps[0])} of shape '{shape.name}' turns normals from the sensor on {share:.1%} of "
                "what is seen of it: where they begin to, the image steps, and this part of the derivative is missing, "
                "a tenth of it with 1 % at the rim of a ball; use a map that is less steep",
                UnsupportedWarning, memory,
            )  # fmt: skip
            continue
        turned = max(_turned_at_rim(si, n, met) for n in normals)
        if turned > TURNED_AT_RIM:
            warn_once(
                f"the {plugin_name(maps[0])} of shape '{shape.name}' bends normals at its rim from the sensor, by "
                f"{turned:.2f} as a mean of sines: where they turn away, just inside of the rim, the image steps, and "
                "this part of the derivative is missing, 1 to 3 % where that is .02, 5 to 6 % where it is .03; use a "
                "map that is less steep",
                UnsupportedWarning, memory,
            )  # fmt: skip


def _changes(node: mi.BSDF) -> bool:
    """Is a bump or normal map itself differentiated?"""
    return any(dr.grad_enabled(value) for _, value in mi.traverse(_texture(node)) if dr.is_diff_v(value))


def _texture(node: mi.BSDF) -> mi.Texture:
    return next(child for child in child_objects(node) if isinstance(child, mi.Texture))


def _maps(bsdf: mi.BSDF | None) -> list[mi.BSDF]:
    """The bump and normal maps below a BSDF."""
    if not isinstance(bsdf, mi.BSDF):
        return []
    own = [bsdf] if plugin_name(bsdf) in BENT_NORMALS else []
    return own + [found for child in child_objects(bsdf) for found in _maps(child)]


def _turned_share(si: mi.SurfaceInteraction3f, n: mi.Normal3f, met: mi.Bool) -> float:
    """Share of the points `met` at which the bent normal `n` is turned from the viewer."""
    towards = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))  # of two-sided surfaces, the side that is seen
    seen, away = _sum(met), _sum(met & (dr.dot(n, towards) <= 0) & (towards.z > SLANTED))
    return away / seen if seen else 0.0


def _turned_at_rim(si: mi.SurfaceInteraction3f, n: mi.Normal3f, met: mi.Bool) -> float:
    """Mean sine of the angle by which normals near the rim are bent from the viewer: they turn away where the cosine of
    the view is below it. 0 without a rim.
    """
    cos = dr.abs(si.wi.z)
    slanted = met & (cos <= SLANTED)
    across = dr.normalize(mi.Vector2f(si.wi.x, si.wi.y))
    away = dr.select(slanted, dr.maximum(-dr.dot(across, mi.Vector2f(n.x, n.y)), 0), 0)
    has_rim = _sum(met & (cos <= AT_RIM)) > RIM_SHARE * _sum(met)
    return _sum(away) / _sum(slanted) if has_rim else 0.0


def _sum(values: mi.Float | mi.Bool) -> float:
    """On the host; of a mask, how often it is set."""
    return float(np.array(dr.sum(dr.select(values, 1.0, 0.0) if dr.is_mask_v(values) else values)).ravel()[0])


def _bent(si: mi.SurfaceInteraction3f, node: mi.BSDF, met: mi.Bool) -> mi.Normal3f:
    """The bent normal in the shading frame, before Mitsuba turns it [Mitsuba 3.9.1, `bumpmap.cpp`, `normalmap.cpp`]."""
    texture = _texture(node)
    if plugin_name(node) == "normalmap":
        return mi.Normal3f(dr.normalize(2 * mi.Vector3f(texture.eval_3(si, met)) - 1))
    slope = mi.traverse(node)["scale"] * texture.eval_1_grad(si, met)
    n = si.sh_frame.n
    across = dr.cross(si.dp_du + n * (slope.x - dr.dot(n, si.dp_du)), si.dp_dv + n * (slope.y - dr.dot(n, si.dp_dv)))
    across *= dr.select(dr.dot(si.n, across) < 0, -1.0, 1.0)
    return mi.Normal3f(si.to_local(dr.normalize(across)))
