"""Why something is 0 or not, in words: what the terms' own `needed` and the plan have in common."""

from __future__ import annotations

from collections.abc import Iterator

from ..options import Options
from ..scene.facts import SceneFacts

#: Why all is black; the film's alpha channel is not.
NO_LIGHT = "the scene has no light source"


def nothing_to_compute(facts: SceneFacts, options: Options) -> str | None:
    """Why the whole derivative is 0, if it is."""
    return next(_nothing(facts, options), None)


def _nothing(facts: SceneFacts, options: Options) -> Iterator[str]:
    if not facts.anything_enabled:
        yield facts.still or "no parameter of the scene has gradients enabled"
    elif options.depth_limit == 0:
        yield "max_depth = 0: paths without a segment carry no light"
    elif not facts.emitters and not facts.sensor.coverage:
        yield NO_LIGHT
    elif not _relevant(facts):
        yield "what has gradients enabled does not enter the image of this sensor"


def _relevant(facts: SceneFacts) -> tuple[str, ...]:
    """The enabled parameters that the image can depend on."""
    names = tuple(n for s in facts.shapes for n in (*s.geometry, *s.shading, *s.material))
    return names + tuple(n for e in facts.emitters for n in (*e.pose, *e.radiance)) + facts.sensor.pose


def what_changes(facts: SceneFacts) -> str:
    """The kinds of things that depend on θ, listed."""
    kinds = [
        (facts.shapes_move, "shapes"),
        (any(s.shading for s in facts.shapes), "shading normals or texture coordinates"),
        (any(s.material for s in facts.shapes), "materials"),
        (facts.emitters_move, "poses of lights"),
        (any(e.radiance for e in facts.emitters), "emission"),
        (facts.camera_moves, "the camera"),
    ]
    return ", ".join(text for there, text in kinds if there)


#: Why nothing is in shadow, nor sees anything: said where all is black, a mirror or smooth glass.
NOTHING_SCATTERS = "no surface scatters light: all are black, mirrors or smooth glass"


def steps_rest(facts: SceneFacts) -> str | None:
    """Why no discontinuity moves, if none does."""
    return None if facts.geometry_moves else "no shape, light or camera moves: discontinuities stay where they are"
