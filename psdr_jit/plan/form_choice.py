"""Which form of the path integral suits a scene, as far as its structure tells; a pilot decides the rest.

Where surfaces of different velocity touch, the geometry term of the material form has a derivative ~ Δv/r of infinite
variance, whose integral is not absolutely convergent: it leaves out what light between the two does in the very corner.
The spatial form has no such kernel, but finds an edge at every visible crease. The mixed form is material where nothing
is close by.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..core.sensor_frame import KINDS
from ..options import FILM, FOLLOWING, MATERIAL, MIXED, SPATIAL, Options, of_vertices
from ..scene.capabilities import WITHOUT_MATERIAL
from ..scene.facts import SceneFacts, ShapeFacts
from .call import Call
from .light_plan import LightPlan
from .plan import Geometry

#: Distance between bounding boxes, relative to the diagonal of the smaller one, up to which shapes count as touching.
CONTACT = 0.02

#: Shapes beyond which nobody looks at all pairs of them: the mixed form is right in any case.
MANY_SHAPES = 300

#: Faces from which a mesh may be round.
MANY_FACES = 100

#: The reason for the first form where a pilot would choose, but has nothing to go by.
NOTHING_TO_COMPARE = "there is no noise to compare the forms by"


def forms_to_try(
    scene: mi.Scene, facts: SceneFacts, options: Options, geometry: Geometry, light: LightPlan | None, film_rests: str
) -> tuple[tuple[str, ...], str]:
    """The forms that come into question, the safer one first, and the reason if there is one only.

    `light`: subpaths as planned. `film_rests`: see `why_film_rests`.
    """
    if options.form in FOLLOWING and film_rests:
        return (SPATIAL,), film_rests
    confined = _why_vertices_slide(facts)
    if options.form != "auto":
        if of_vertices(options.form) == SPATIAL or not confined:
            return (options.form,), "as asked for"
        return (FILM if options.form in FOLLOWING else SPATIAL,), confined
    forms, reason = ((SPATIAL,), confined) if confined else _of_vertices(scene, facts, options, geometry)
    followed = (shape for shape in facts.shapes if facts.camera_moves or shape.moves)
    uneven = (light is not None and light.runs) or any(_uneven(shape) for shape in followed)
    if film_rests or not uneven:  # it has more noise then, not less
        return forms, reason
    following = {vertices: form for form, vertices in FOLLOWING.items()}
    return (*forms, following[forms[-1]]), NOTHING_TO_COMPARE


def _why_vertices_slide(facts: SceneFacts) -> str:
    """Why vertices cannot stay on their material points, "" if they can."""
    if not facts.geometry_moves:
        return ""
    if facts.has_delta_lobes:
        return "directions follow mirrors and glass"
    # points of a B-spline are followed, but not as its texture coordinates turn about its axis
    unmapped = [s.name for s in facts.shapes if s.plugin in WITHOUT_MATERIAL or (s.kind == "curve" and s.patterns)]
    return f"the points of '{unmapped[0]}' are not followed" if unmapped else ""


def _uneven(shape: ShapeFacts) -> bool:
    """Does what a pixel sees of it change as it moves: by a texture, or by where its surface turns from the viewer?

    What light subpaths are aimed for, a caustic on it or the lobes of rough glass, is uneven on flat surfaces as well.
    """
    flat = shape.plugin in ("rectangle", "disk") or (shape.kind == "mesh" and shape.faces < MANY_FACES)
    return shape.painted or shape.smooth or not flat


def why_film_rests(call: Call, facts: SceneFacts, light: LightPlan | None) -> str:
    """Why places on the film cannot follow what is seen, with light subpaths as planned; "" if they can."""
    if not (facts.camera_moves or facts.shapes_move):
        return "camera and shapes rest, and so do places on the film"
    if call.sensor.class_name() not in KINDS:
        return f"places on the film of a '{call.sensor.class_name()}' are not followed"
    if light is not None and light.runs and call.film.rfilter().is_box_filter():
        return "light subpaths do not end on borders of pixels"
    return ""


def why_film_is_not_tried(call: Call) -> str:
    """Why a pilot does not weigh forms in which film positions follow what is seen, unless they are asked for."""
    if call.options.form == "auto" and call.film.rfilter().is_box_filter():
        return "what crosses the borders of pixels takes paths of its own"
    return ""


def _of_vertices(
    scene: mi.Scene, facts: SceneFacts, options: Options, geometry: Geometry
) -> tuple[tuple[str, ...], str]:
    """The forms that differ in what path vertices do."""
    if not facts.geometry_moves:
        return (SPATIAL,), "nothing moves, so the forms are the same"
    if options.depth_limit < 3:
        return (SPATIAL,), "light is scattered once at most, so the forms are the same"
    if geometry.touched_lamp:
        return (SPATIAL,), f"'{geometry.touched_lamp}' touches what it shines on"
    touching = _touching(scene, facts)
    return ((SPATIAL, MIXED), touching) if touching else ((SPATIAL, MATERIAL), NOTHING_TO_COMPARE)


def _touching(scene: mi.Scene, facts: SceneFacts) -> str:
    """Two shapes whose bounding boxes touch, and of which one moves, or the camera before them; "" if none do."""
    known, shapes = [s for s in facts.shapes if s.index >= 0], scene.shapes()
    if len(known) > MANY_SHAPES:
        return f"of {len(known)} shapes, some may touch"
    boxes = [shapes[s.index].bbox() for s in known]
    corners = np.array([(*b.min, *b.max) for b in boxes], float).reshape(-1, 2, 3)
    lower, upper = corners[:, 0], corners[:, 1]
    size = np.linalg.norm(upper - lower, axis=1)
    gap = np.maximum(lower - upper[:, None], lower[:, None] - upper).max(2)
    for a, b in np.argwhere(np.triu(gap <= CONTACT * np.minimum(size, size[:, None]), 1)):
        one, other = known[a], known[b]
        if one.moves != other.moves:
            return f"'{one.name}' and '{other.name}' touch and move against each other"
        if one.moves or facts.camera_moves:
            return f"'{one.name}' and '{other.name}' touch, and what is seen slides over both"
    return ""
