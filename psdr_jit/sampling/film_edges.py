"""Which edges the sensor may see to move, and how their rows are drawn: by how much of the film they cover."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edges.scene_table import scene_edges
from ..edges.table import EdgeTable
from ..plan.job import Job
from .rows import ROW_SAMPLER, SampledRows, row_state, with_static_share


@dataclass(frozen=True)
class FilmEdges(SampledRows):
    """What can be seen to move."""

    table: EdgeTable


def film_weights(job: Job) -> list[mi.Float]:
    """By kind of edge, the weight of each row: of moving shapes, or of all if camera rays move.

    Rays from film positions that follow shapes move but where those are seen.
    """
    table = scene_edges(job)
    border = job.film.rfilter().border_size() if job.film.sample_border() else 0
    weights = table.weights(lambda kind: kind.film_weights(job.frame, border))
    if job.facts.camera_moves or not job.plan.prunes:
        return weights
    if job.facts.places_move:
        return with_static_share(weights, table.moving())
    return [dr.select(moves, w, 0) for w, moves in zip(weights, table.moving(), strict=True)]


def film_edges(job: Job, what: str, weights: Callable[[], list[mi.Float]]) -> FilmEdges | None:
    """Edges with these weights, by kind and row, for `what` is estimated with them. None: nothing can contribute."""
    state = row_state(job, what, weights)
    return None if state is None else FilmEdges(scene_edges(job), job.call.memory[ROW_SAMPLER], state)
