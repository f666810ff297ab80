"""What there is to know about a light source."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from .capabilities import CONE_PARAMETERS, POSE_PARAMETERS, UNIFORM_EMITTERS
from .graph import SceneGraph, is_painted, jumping_textures, plugin_name, rim_of_cone
from .patterns import missing_patterns, steps_of_light
from .pose_faults import sky_pose_fault


@dataclass(frozen=True)
class EmitterFacts:
    """One light source. The pose of an area light is its shape's geometry and is not repeated here."""

    name: str
    plugin: str  # as written in XML, for example "area" or "envmap"
    shape: int  # index in SceneFacts.shapes, -1 if it has none
    delta: bool  # a point or a direction: reached by emitter sampling only
    infinite: bool
    varies: bool  # what is seen of it directly differs from point to point or with the direction
    rim: str  # of a spot's cone, see `graph.rim_of_cone`
    steps: tuple[str, ...]  # of a projector or spot: steps of its light that are edges, "its frame", "bitmap 'slide'"
    jumps: tuple[str, ...]  # other discontinuous textures, but for those on a shape that are `ShapeFacts.patterns`
    pose: tuple[str, ...]  # enabled parameters that move it, or its steps
    radiance: tuple[str, ...]  # all other enabled parameters
    pose_fault: str  # why Mitsuba does not show its pose as it says, and the way out; "" if it does


def emitter_facts(graph: SceneGraph, emitter: mi.Emitter, index: int, shapes: list) -> EmitterFacts:
    """The facts about `emitter`, number `index` of the scene with these `shapes`."""
    enabled, plugin = graph.enabled_of(emitter), plugin_name(emitter)
    flags = emitter.flags()
    owners = [i for i, shape in enumerate(shapes) if shape.emitter() is emitter]
    name = graph.name(shapes[owners[0]], owners[0]) if owners else graph.name(emitter, index)
    jumps, rim = jumping_textures(graph, emitter), rim_of_cone(graph, emitter)
    steps = steps_of_light(emitter, plugin, rim, jumps)
    moving = POSE_PARAMETERS | (CONE_PARAMETERS if steps else frozenset())
    pose = tuple(name for name in enabled if name in moving)
    return EmitterFacts(
        name=name,
        plugin=plugin,
        shape=owners[0] if owners else -1,
        delta=bool(flags & int(mi.EmitterFlags.Delta)),
        infinite=bool(flags & int(mi.EmitterFlags.Infinite)),
        varies=plugin not in UNIFORM_EMITTERS or is_painted(graph, emitter),
        rim=rim,
        steps=steps,
        jumps=missing_patterns(jumps) if steps or (owners and plugin == "area") else jumps,
        pose=pose,
        radiance=tuple(n for n in enabled if n not in pose) + graph.enabled_below(emitter, skip=(mi.Shape,)),
        pose_fault=sky_pose_fault(graph, emitter, plugin),
    )
