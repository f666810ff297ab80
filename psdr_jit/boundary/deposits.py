"""What the vertices of a sensor subpath take of the covector on its receiver's motion (`sensor_subpath.py`)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..plan.job import Job


def deposit(a: mi.Vector3f, n: mi.Normal3f, ω: mi.Vector3f) -> mi.Vector3f:
    """Covector n (a·ω)/(n·ω) that a vertex with normal n receives; 0 at exactly grazing incidence."""
    cos = dr.dot(n, ω)
    return mi.Vector3f(n) * dr.select(cos != 0, dr.dot(a, ω) / cos, 0)


def carried_off(
    job: Job,
    a: mi.Vector3f,
    n: mi.Normal3f,
    following: mi.Ray3f,
    found: mi.PreliminaryIntersection3f,
    active: mi.Bool,
) -> mi.Vector3f:
    """What a vertex keeps of the covector if the path goes on: all of it where it does not slide.

    `found`: the vertex nearer to the sensor, which `following` meets.
    """
    if job.form == "material":
        return mi.Vector3f(a)
    g = deposit(a, n, -following.d)
    if job.form == "spatial":
        return g
    return dr.select(job.close_by.met_by(following, found, -following.d, active), g, a)
