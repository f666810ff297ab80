"""Which face of a smooth-shaded light: in proportion to what is sent along its plane."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.memory import Slot
from ..edges.coarse import bends
from ..edges.horizons import Horizons
from ..plan.job import Job
from .horizons import SampledHorizons, all_around, flags, smooth_faces, spread
from .rows import ROW_SAMPLER, row_state

#: Of one render call: the table, in a list so that none can be told from not asked for.
TABLE: Slot[list[Horizons | None]] = Slot(list)

#: Angle between a shading normal and its face [degrees] from which what a light sends along its faces is worth samples.
#: A ball of 64 segments has 2.8, and without it 1 to 2 % too little.
LEAST_BEND = 0.5


def sampled_light_horizons(job: Job) -> SampledHorizons | None:
    """The planes of the faces of smooth-shaded lights; None without any."""
    table = _table(job)
    if table is None:
        return None
    state = row_state(job, "direct/light_horizons", lambda: light_horizon_weights(job))
    return None if state is None else SampledHorizons(table, job.call.memory[ROW_SAMPLER], state)


def light_horizon_weights(job: Job) -> list[mi.Float]:
    """The relative weight of each face, in a list of one; of none without any."""
    table = _table(job)
    if table is None:
        return []
    rows, face = table.face(dr.arange(mi.UInt32, table.count))
    chosen = dr.gather(mi.UInt32, flags(_glow(job)), rows.shape) != 0
    weight = face.area * spread(face)
    return [dr.select(chosen & dr.isfinite(weight), weight, 0)]


def _table(job: Job) -> Horizons | None:
    """Built once per render call."""
    known = job.shared[TABLE]
    if not known:
        known.append(Horizons(smooth_faces(job), all_around()) if any(_glow(job)) else None)
    return known[0]


def _glow(job: Job) -> list[bool]:
    """By smooth-shaded mesh: does it shine, and is it faceted enough to matter?"""
    faces = smooth_faces(job)
    meshes = () if faces is None else faces.meshes
    return [mesh.is_emitter() and bends(mesh, LEAST_BEND, job.call.memory) for mesh in meshes]
