"""Edges far behind everything that is seen take few samples from those that are close by.

Where a line through an edge matters is not known before it is traced, so edges are drawn by their length. On a ground
of 10⁴ units the four borders are a thousand times as long as what stands on it, and next to no sample was left for the
shadows of that: a derivative of 0, with an error of 0. What a far edge brings goes with the angle that it covers, its
length ℓ over its distance d, and so does its weight here once it is `FAR` times as far as what is seen,

    ℓ · min(1, FAR · R / d),    1/R = Σ_i f_i / d_i / Σ_i f_i

f_i: what edge i may cover on the film. Weights stay above 0, so nothing is left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.memory import Slot
from ..core.sensor_frame import viewpoint
from ..edges.film_cover import LENS_CENTRE
from ..edges.scene_table import scene_edges
from ..plan.job import Job
from .film_edges import film_weights

#: Multiples of the distance of what is seen up to which edges count by their length alone.
FAR = 4.0


#: Of one render call: the factors.
FACTORS: Slot[list[mi.Float] | None] = Slot(lambda: None)


def nearness(job: Job) -> list[mi.Float] | None:
    """By kind of edge, the factor on the weight of each row; None for parallel views, which are at no distance."""
    return job.shared.once(FACTORS, lambda: _found(job))


def _found(job: Job) -> list[mi.Float] | None:
    table, eye = scene_edges(job), viewpoint(job.frame, mi.Point2f(LENS_CENTRE))
    if job.frame.kind == "orthographic" or not table.kinds:
        return None
    away = table.weights(lambda kind: dr.norm(kind.places() - mi.Point3f(eye.x, eye.y, eye.z)))
    on_film = film_weights(job)
    covered = sum(dr.sum(f) for f in on_film)
    near = sum(dr.sum(dr.select(d > 0, f / d, 0)) for f, d in zip(on_film, away, strict=True))
    reach = dr.select(near > 0, FAR * covered / near, dr.inf)
    dr.make_opaque(reach)
    return [dr.select(d > reach, reach / d, 1) for d in away]
