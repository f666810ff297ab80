"""What goes on from x_D to the sensor, before it is known by which path: straight, as most does."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.sensor_frame import towards_viewer, viewpoint
from ..edges.film_cover import LENS_CENTRE
from ..paths.smooth_lights import share
from ..plan.job import Job


def facing_sensor(job: Job, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """The same with `wi` towards the middle of the sensor."""
    eye = viewpoint(job.frame, mi.Point2f(LENS_CENTRE))
    si.wi = si.to_local(dr.normalize(towards_viewer(eye, si.p)))
    return si


def share_towards_sensor(
    job: Job, receiver: Hit, light: mi.SurfaceInteraction3f, ω: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """`(R, ρ)` of `paths.smooth_lights` for what comes along ω from `light` to x_D; both 1 for other lights. Detached.

    R depends on where the path goes on from x_D through p_b, where that is not diffuse.
    """
    si = facing_sensor(job, receiver.interaction(active))
    return share(job.scene, si, si.bsdf(), light, ω, active)
