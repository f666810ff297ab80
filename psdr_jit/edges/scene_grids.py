"""The grids of a scene, read once per render call, and kept from call to call while they rest."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.memory import Memory, Slot
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.grids import TO_WORLD, VALUES, blends_normals
from .edge_shapes import GridPlace, edge_shapes
from .grid_set import GridSet, grid_set

#: Values along an axis from which the band along outlines, in which blended normals turn away, is narrow enough.
FINE = 48

#: Of an integrator: what grids were made from, and these grids.
KNOWN: Slot[tuple[list, GridSet] | None] = Slot(lambda: None)


def scene_grids(job: Job) -> GridSet | None:
    """The grids of signed distances; None if there are none."""
    places = edge_shapes(job).grids
    _warn_about_coarse(places, job.call.memory)
    if not places or any(place.facts.moves for place in places):
        return grid_set(places)
    arrays = [array for place in places for array in _arrays(place)]
    known = job.call.memory[KNOWN]
    # whatever changes an array replaces it by another; those that are kept keep their index
    if known is None or [a.index for a in known[0]] != [a.index for a in arrays]:
        known = (arrays, grid_set(places))
        job.call.memory[KNOWN] = known
    return known[1]


def _arrays(place: GridPlace) -> list:
    params = mi.traverse(place.shape)
    maps = [params[TO_WORLD]] + ([mi.traverse(place.instance)[TO_WORLD]] if place.instance is not None else [])
    entries = [dr.detach(m.matrix[i, j]) for m in maps for i in range(3) for j in range(4)]
    return [dr.detach(params[VALUES].array), *entries]


def _warn_about_coarse(places: list[GridPlace], memory: Memory) -> None:
    """Name grids with blended normals and few values, once each."""
    for place in places:
        values = mi.traverse(place.shape)[VALUES].shape[0]
        if values < FINE and blends_normals(place.shape, memory):
            warn_once(
                f"SDF grid '{place.shape.id()}' of {values} values a side is shaded with blended normals, which turn "
                "away in a band about a cell wide along its outlines: the derivative takes the band's inner border for "
                "the outline, and is up to a third off there; set normals to 'analytic', or use a finer grid",
                UnsupportedWarning,
                memory,
            )
