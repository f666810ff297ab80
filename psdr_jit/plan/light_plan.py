"""Do light subpaths run, and why: where small lights shine on surfaces that may focus them, and nowhere else.

What a camera path finds well costs only time to find again. Light subpaths are therefore aimed at surfaces that
scatter in or near the mirrored or bent direction (`paths.light_technique.focuses`); a scene without any is left to
camera paths, and so are lamps that look wide from what mirrors or bends light without scattering it, and skies but for
those with a sun.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.memory import Memory
from ..core.sensor_frame import KINDS, SensorFrame
from ..core.varying import varying
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..options import Options
from ..paths.light_source import light_sources
from ..paths.light_technique import FOCUSING, SHORTEST, LightTechnique, average
from ..scene.facts import SceneFacts, ShapeFacts

#: Lights that are traced. Where the others are, camera paths find them alone.
TRACED = ("area", "envmap", "constant", "sunsky", "point", "spot", "directional")

#: Light subpaths for each camera sample: of images and of what materials change, and where something moves. There 4 of
#: them bring variance × time to .74 of that with 2 (geometric mean of 19 cases of glass and metal, .33 to 1.2), and 8
#: to .71 (.15 to 1.6); while an index changes 4 are as good as 2 (four cases, .75 to 1.2).
PER_SAMPLE, WHERE_THINGS_MOVE = 2, 4

#: Surface vertices of a light subpath, at most; longer paths are left to the camera's.
LONGEST = 8

#: Size of a surface relative to the scene from which on there is nothing to aim at: a floor or a wall.
SPANS = 0.8

#: Solid angle of a light, seen from a mirror or smooth glass [sr], from which on camera paths find what these make of
#: it with less noise: 40 times less for a lamp of .02 sr over a ball of glass that moves, 1.6 times more for .004 sr.
#: Rough glass and metal spread it: there light subpaths win at any size, 1.2 to 90 times. Not so from the sky, where
#: smooth glass that moves never gains (30 times more variance below a sun of .004 sr), and rough surfaces gain up to 15
#: times below that sun, but not below one of .1 sr.
LARGE = 0.01

#: Directions by which the solid angle of what shines in the sky is told.
SKY_DIRECTIONS = 4096

#: Surfaces that subpaths are aimed at one by one.
MOST_TARGETS = 8


@dataclass(frozen=True)
class LightPlan:
    """Pure data, a part of the plan."""

    runs: bool
    reason: str
    per_sample: int = PER_SAMPLE  # light subpaths for each camera sample

    def __str__(self) -> str:
        return f"{self.per_sample} per camera sample: {self.reason}" if self.runs else f"none: {self.reason}"

    def subpaths(self, frame: SensorFrame, spp: int) -> int:
        """Number of light subpaths beside `spp` camera samples per pixel."""
        (x0, y0), (x1, y1) = frame.window
        return self.per_sample * spp * round((x1 - x0) * (y1 - y0))


def traced_lights(facts: SceneFacts) -> list[int]:
    """Numbers of the lights in the scene that are traced.

    Not smooth-shaded meshes: Mitsuba weighs what emitter sampling finds there by other normals than what scattering
    does, and light subpaths can agree with one of them only. Nor, beside smooth-shaded mirrors and glass, any light
    that camera paths find: delta lobes about normals that are not the surface's do not keep étendue, which the weights
    of `paths.light_technique` take for granted. Nor skies that Mitsuba samples by another density than it says (those
    with a `pose_fault`).
    """
    uneven = any(s.smooth and s.is_mesh for s in _mirrors(facts))

    def even(shape: ShapeFacts) -> bool:
        return shape.index >= 0 and not shape.smooth and shape.kind in ("mesh", "analytic")

    return [
        k
        for k, light in enumerate(facts.emitters)
        if light.plugin in TRACED and not light.pose_fault and (light.delta or not uneven)
        and (light.shape < 0 or even(facts.shapes[light.shape]))
    ]


def narrow_shapes(facts: SceneFacts) -> list[int]:
    """Numbers of the shapes in the scene that scatter light in or near one direction, and not diffusely as well."""
    narrow, diffuse = sum(int(getattr(mi.BSDFFlags, lobe)) for lobe in FOCUSING), int(mi.BSDFFlags.Diffuse)
    return [s.index for s in facts.shapes if s.index >= 0 and s.bsdf_flags & narrow and not s.bsdf_flags & diffuse]


def focusing_shapes(scene: mi.Scene, facts: SceneFacts) -> list[int]:
    """Those of them that may gather light on others, and that one can aim at.

    What mirrors make of the light of points is found in no other way: where there are some, every mirror counts.
    """
    sizes = {k: scene.shapes()[k].bbox().extents() for k in narrow_shapes(facts)}
    bodies = [k for k, size in sizes.items() if math.hypot(*size) < SPANS * facts.extent]
    points = any(light.delta and light.plugin in TRACED for light in facts.emitters)
    return sorted({*bodies, *(s.index for s in _mirrors(facts) if s.index >= 0)}) if points else bodies


def _mirrors(facts: SceneFacts) -> list[ShapeFacts]:
    """Shapes that mirror or bend light without scattering it."""
    return [s for s in facts.shapes if any("Null" not in lobe for lobe in s.delta_lobes)]


def plan_light(
    scene: mi.Scene, facts: SceneFacts, options: Options, memory: Memory | None
) -> LightPlan | None:
    """Whether light subpaths are traced; None of an integrator that does not know them, or is not to use them.

    Warns of light that one might expect them to find, once per `memory`.
    """
    if options.light_paths == "off":
        return None
    if dr.flag(dr.JitFlag.FreezingScope):
        return LightPlan(False, "where lights and surfaces are cannot be read while a function is being frozen")
    targets = focusing_shapes(scene, facts)
    _warn_about_unseen_light(facts, targets, memory)
    traced = traced_lights(facts)
    for obstacle, reason in (
        (not narrow_shapes(facts) and not targets, "no surface is glass or a mirror, nothing is focused"),
        (not traced, f"no light is of the kinds that are traced: {', '.join(TRACED)} (beside "
                                   "smooth-shaded mirrors and glass the last three)"),
        (not targets, "glass and mirrors span the scene, there is nothing to aim at"),
        (not _worth_tracing(scene, facts, options, traced, targets),
         "what glass and mirrors make of lights as large as these, camera paths find with less noise"),
        (options.depth_limit <= SHORTEST, f"max_depth = {options.max_depth}: too short for light by way of a surface"),
        (facts.sensor.plugin not in KINDS.values(), f"nothing is connected to a '{facts.sensor.plugin}' sensor"),
    ):
        if obstacle:
            return LightPlan(False, reason)
    names = ", ".join(f"'{s.name}'" for s in facts.shapes if s.index in targets[:3])
    per_sample = WHERE_THINGS_MOVE if facts.geometry_moves else PER_SAMPLE
    return LightPlan(True, f"{names}{' and others' if len(targets) > 3 else ''} may focus light", per_sample)


def light_technique(
    scene: mi.Scene, facts: SceneFacts, frame: SensorFrame, options: Options, plan: LightPlan, prunes: bool
) -> LightTechnique | None:
    """The technique itself, for a plan that has it run; None where there is nothing to trace.

    `prunes`: what has no derivative is left out. While nothing but lights without a shape changes, that is the light of
    all others.
    """
    targets = focusing_shapes(scene, facts)
    lights = _worth_tracing(scene, facts, options, traced_lights(facts), targets)
    if prunes and _only_lights_change(facts):
        lights = [k for k in lights if facts.emitters[k].pose or facts.emitters[k].radiance]
    if not (lights and targets):
        return None
    return LightTechnique(
        sources=light_sources(scene, lights, targets, MOST_TARGETS),
        frame=frame,
        ratio=varying(mi.Float, float(plan.subpaths(frame, 1))),
        longest=min(options.depth_limit - 1, LONGEST),
        exclusive=options.light_paths == "only",
        delta_lobes=facts.has_delta_lobes,
    )


def _worth_tracing(
    scene: mi.Scene, facts: SceneFacts, options: Options, lights: list[int], targets: list[int]
) -> list[int]:
    """Numbers of those of the `lights` that camera paths do not find well by way of the `targets`."""
    if options.light_paths == "only":
        return lights
    scattering = ({*narrow_shapes(facts)} - {s.index for s in _mirrors(facts)}) & {*targets}
    shapes = scene.shapes()
    centres = [shapes[k].bbox().center() for k in targets]

    def worth(k: int) -> bool:
        light = facts.emitters[k]
        if light.delta:
            return True
        if light.shape < 0:
            return bool(scattering) and sky_solid_angle(scene.emitters()[k]) < LARGE
        box = shapes[light.shape].bbox()
        area = math.hypot(*box.extents()) ** 2 / 2
        return bool(scattering) or all(area < LARGE * math.dist(box.center(), centre) ** 2 for centre in centres)

    return [k for k in lights if worth(k)]


def sky_solid_angle(sky: mi.Emitter) -> float:
    """The solid angle of what shines in it, (∫L)² / ∫L² [sr]: 4π of an even sky, that of the sun if nothing else does.

    By the sky's own emitter sampling, with density p: ⟨L/p⟩² / ⟨L²/p⟩ over its directions. 4π of a black one.
    """
    number = dr.arange(mi.UInt32, SKY_DIRECTIONS)
    u = mi.Point2f((mi.Float(number) + 0.5) / SKY_DIRECTIONS, mi.radical_inverse_2(number, 0))
    with dr.suspend_grad():
        ds, weight = sky.sample_direction(dr.zeros(mi.SurfaceInteraction3f, SKY_DIRECTIONS), u)
        over_pdf = average(weight)
        mean, squared = dr.mean(over_pdf)[0], dr.mean(dr.square(over_pdf) * ds.pdf)[0]
    return min(4 * math.pi, mean**2 / squared) if squared > 0 else 4 * math.pi


def _only_lights_change(facts: SceneFacts) -> bool:
    """Do shapes, materials and the camera rest?"""
    return not (
        facts.shapes_move
        or facts.paths_bend
        or facts.camera_moves
        or any(s.shading or s.material or s.geometry for s in facts.shapes)
    )


def _warn_about_unseen_light(facts: SceneFacts, targets: list[int], memory: Memory | None) -> None:
    """A point's light by way of a mirror or smooth glass: from the camera's side nothing finds it."""
    mirrors = _mirrors(facts)
    points = [e for e in facts.emitters if e.delta]
    if not (points and mirrors):
        return
    far = [e for e in points if e.plugin not in TRACED]
    beside = [s for s in mirrors if s.index not in targets]
    shown = f"light of {_listed(far or points)} that {_listed(beside or mirrors)} mirrors or bends onto other surfaces"
    if far or beside:
        why = f"light subpaths start from {', '.join(TRACED)} lights and are aimed at shapes that are no instances"
        message = f"{shown} is not in the image, as in Mitsuba's path: {why}; make the light an area light"
    else:
        message = f"{shown} is in the image, but not what mirrors and smooth glass show of it, as in Mitsuba's path"
    warn_once(message, UnsupportedWarning, memory)


def _listed(things: list) -> str:
    """Lights or shapes by their names, three at most."""
    return ", ".join(f"'{t.name}' ({t.plugin})" for t in things[:3]) + (" and others" if len(things) > 3 else "")
