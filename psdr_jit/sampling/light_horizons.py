"""Which face of a smooth-shaded light: in proportion to what is sent along its plane."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..edges.coarse import bends
from ..edges.horizons import Horizons
from ..plan.job import Job
from .horizons import SampledHorizons, all_around, built_once, flags, sampled, smooth_faces, spread

#: What tables and samplers know them by.
WHICH = "direct/light_horizons"

#: Angle between a shading normal and its face [degrees] from which what a light sends along its faces is worth samples.
#: A ball of 64 segments has 2.8.
LEAST_BEND = 0.5


def sampled_light_horizons(job: Job) -> SampledHorizons | None:
    """The planes of the faces of smooth-shaded lights; None without any."""
    return sampled(job, WHICH, _table(job), lambda: light_horizon_weights(job))


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
    return built_once(job, WHICH, lambda: Horizons(smooth_faces(job), all_around()) if any(_glow(job)) else None)


def _glow(job: Job) -> list[bool]:
    """By smooth-shaded mesh: does it shine, and is it faceted enough to matter?"""
    faces = smooth_faces(job)
    meshes = () if faces is None else faces.meshes
    return [mesh.is_emitter() and bends(mesh, LEAST_BEND, job.call.memory) for mesh in meshes]
