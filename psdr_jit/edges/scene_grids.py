"""The grids of a scene, read once per render call, and kept from call to call while they rest."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.memory import Slot, while_unchanged
from ..plan.job import Job
from ..scene.grids import TO_WORLD, VALUES
from .edge_shapes import GridPlace, edge_shapes
from .grid_set import GridSet, grid_set

#: Of an integrator: by how many places grids are shown in, what they were made from, and these grids.
KNOWN: Slot[dict[int, tuple[list, GridSet]]] = Slot(dict)


def scene_grids(job: Job) -> GridSet | None:
    """The grids of signed distances; None if there are none."""
    places = edge_shapes(job).grids
    if not places or any(place.facts.moves for place in places):
        return grid_set(places)
    arrays = [array for place in places for array in _arrays(place)]
    return while_unchanged(job.call.memory[KNOWN], len(places), arrays, lambda: grid_set(places))


def _arrays(place: GridPlace) -> list:
    params = mi.traverse(place.shape)
    maps = [params[TO_WORLD]] + ([mi.traverse(place.instance)[TO_WORLD]] if place.instance is not None else [])
    entries = [dr.detach(m.matrix[i, j]) for m in maps for i in range(3) for j in range(4)]
    return [dr.detach(params[VALUES].array), *entries]
