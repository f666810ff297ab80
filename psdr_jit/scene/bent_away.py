"""Bent normals that turn from the sensor where no edge stands for the curves at which that begins.

Mitsuba turns them over there (`flip_invalid_normals`), or the nested BSDF ends: what a bump or normal map sends steps.
Edges stand for that on meshes, disks, cylinders and spheres (`edges.kind_bent`) as they move. Named are maps that are
differentiated themselves, maps within maps, and those of curves, grids and ellipsoids, if they are steep for how they
are looked at.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory
from ..core.sensor_frame import sensor_frame
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .bent_normals import BentMap, bent_maps, nested_maps
from .facts import SceneFacts, ShapeFacts
from .names import plugin_name
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


#: Kinds of shapes on which edges stand for the curves.
WITH_EDGES = ("mesh", "analytic")


def warn_about_bent_normals(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> None:
    """Name shapes of which the sensor sees many points whose bent normals turn from it, once each."""
    bent = [(shape, why, maps) for shape in facts.shapes if shape.index >= 0 and shape.sees_frame
            and (maps := bent_maps(scene.shapes()[shape.index].bsdf()))
            and (why := _without_edges(shape, maps, facts.view_moves or shape.moves))]  # fmt: skip
    if not bent:
        return
    o, d, _, _ = lines_of_sight(scene, sensor_frame(sensor))
    ray, pi, number = first_hits(scene, o, d)
    for shape, why, maps in bent:
        met = number == shape.index + 1
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, met)
        normals = [bent.normal(si, met) for bent in maps]
        name = f"{plugin_name(maps[0].node)} of shape '{shape.name}'"
        share = max(_turned_share(si, n, met) for n in normals)
        if share > TURNED_SHARE:
            warn_once(
                f"the {name} turns normals from the sensor on {share:.1%} of what is seen of it: where they begin to, "
                f"the image steps, and as {why}, this part of the derivative is missing, a tenth of it with 1 % at the "
                "rim of a ball; use a map that is less steep",
                UnsupportedWarning, memory,
            )  # fmt: skip
            continue
        turned = max(_turned_at_rim(si, n, met) for n in normals)
        if turned > TURNED_AT_RIM:
            warn_once(
                f"the {name} bends normals at its rim from the sensor, by {turned:.2f} as a mean of sines: where they "
                f"turn away, just inside of the rim, the image steps, and as {why}, this part of the derivative is "
                "missing, 1 to 3 % where that is .02, 5 to 6 % where it is .03; use a map that is less steep",
                UnsupportedWarning, memory,
            )  # fmt: skip


def _without_edges(shape: ShapeFacts, maps: list[BentMap], moves: bool) -> str:
    """Why curves move for which no edges stand; "" if none do."""
    inner = [found for bent in maps for found in nested_maps(bent)]
    if any(map(_changes, maps + inner)):
        return "the map itself is differentiated"
    if moves and inner:
        return "it holds another map"
    return f"it is on a shape of plugin '{shape.plugin}'" if moves and shape.kind not in WITH_EDGES else ""


def _changes(bent: BentMap) -> bool:
    """Is a bump or normal map itself differentiated?"""
    return any(dr.grad_enabled(value) for _, value in mi.traverse(bent.texture) if dr.is_diff_v(value))


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
