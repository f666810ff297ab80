"""Derivatives of boundary segments found in the middle of a path, written once for the direct and indirect terms.

Each connection of a recorded sensor subpath has a value W (detached) and a motion (attached, primal value 0):

    M_k = n_⊥·v_B + source + Σ_{j<k} g_j^continue·v_j + g_k^connect·v_k + (what is left)·camera ray

Forward mode takes the tangent of every summand at once and sums along the subpath; backward mode turns the film's
adjoint into one weight per summand by suffix sums. Neither traces a ray, and both are exact transposes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate, tangents
from ..core.records import Hit
from ..edges.table import EdgeTable, edge_motion, row_moves
from ..plan.job import Job, passes
from ..plan.probe_motion import Trial
from .sensor_subpath import SubpathRecords


@dataclass(frozen=True)
class BoundarySamples:
    """Boundary segments with their sensor subpaths. Lanes: segments; flat: vertex-major connections."""

    table: EdgeTable
    row: mi.UInt32
    t: mi.Float
    local: mi.Point3f
    n: mi.Vector3f  # n_⊥
    wavelengths: mi.Color0f
    records: SubpathRecords
    value: mi.Spectrum  # flat: splatted per unit of motion
    source_motion: Callable[[], mi.Float]  # attached, per lane, primal value 0
    x: mi.Point3f  # x_B
    source: Hit  # x_S; no shape: a light without one
    source_covector: mi.Vector3f  # on its velocity


Prepare = Callable[[Job], "BoundarySamples | None"]


@dataclass
class _Motion:
    """Attached scalars of primal value 0."""

    segment: mi.Float  # per lane
    connect: mi.Float  # flat
    go_on: mi.Float
    camera: mi.Float


def motion_of(hit: Hit, covector: mi.Vector3f) -> mi.Float:
    """`covector` applied to the material point `hit`, attached; 0 where there is no surface."""
    there, flags = hit.shape != 0, mi.RayFlags.Minimal | mi.RayFlags.FollowShape
    x = hit.intersection().compute_surface_interaction(mi.Ray3f(hit.o, hit.d), flags, there).p
    return dr.select(there, dr.dot(covector, x), 0)


def _motion(job: Job, s: BoundarySamples) -> _Motion:
    at_edge = dr.dot(s.n, edge_motion(s.table, s.row, s.t, s.local)) + s.source_motion()
    c = s.records.data
    ray = mi.Ray3f(c.hit.o, c.hit.d)
    follow = mi.RayFlags.Minimal | mi.RayFlags.FollowShape
    x = c.hit.intersection().compute_surface_interaction(ray, follow, c.hit.shape != 0).p
    connect, go_on = dr.dot(c.deposit_connect, x), dr.dot(c.deposit_continue, x)
    camera = mi.Float(0)
    if job.facts.camera_moves:
        ray, _ = job.sensor.sample_ray(0, 0.5, c.film, c.aperture)
        depth = dr.detach(dr.dot(c.hit.o + c.hit.d * c.hit.t - ray.o, ray.d))
        camera = dr.dot(c.camera, ray.o + depth * ray.d)
    zero = [value - dr.detach(value) for value in (connect, go_on, camera)]
    return _Motion(at_edge, *zero)


def _trial_motion(trial: Trial, s: BoundarySamples) -> mi.Float:
    """Velocity of every connection in a trial motion (flat). Detached."""
    c = s.records.data
    at_edge = trial.along(s.n, s.x, row_moves(s.table, s.row))
    x_s = s.source.o + dr.select(s.source.shape != 0, s.source.t, 0) * s.source.d
    at_edge += trial.along(s.source_covector, x_s, trial.takes_part(s.source.shape))
    of_light = (s.source.shape == 0) & mi.Bool(trial.lights)  # shifted only: where it is, nobody says
    at_edge += dr.select(of_light, dr.dot(s.source_covector, trial.shift), 0)
    x, moves = c.hit.o + c.hit.t * c.hit.d, trial.takes_part(c.hit.shape)
    go_on, connect = (trial.along(g, x, moves) for g in (c.deposit_continue, c.deposit_connect))
    camera = trial.along(c.camera, x, mi.Bool(trial.camera))
    dr.eval(at_edge, go_on)
    return dr.gather(mi.Float, at_edge, s.records.lane_of()) + s.records.before(go_on) + connect + camera


def _splat(job: Job, s: BoundarySamples, motion: mi.Float) -> mi.TensorXf:
    c = s.records.data
    wavelengths = s.wavelengths
    if mi.is_spectral:
        wavelengths = dr.gather(type(wavelengths), wavelengths, s.records.lane_of())
    landed = dr.any(s.value != 0)
    return films.develop_boundary(job.film, c.p, s.value * motion, mi.Float(0), wavelengths, landed)


def forward(job: Job, prepare: Prepare, longest: int) -> mi.TensorXf:
    """Derivative image along the tangents set on the scene's parameters, in passes that fit into memory. Detached.

    `prepare` samples, traces and records one pass; `longest`: vertices of the longest sensor subpath.
    """
    if longest < 1:
        return films.black(job.film)
    with dr.suspend_grad():
        parts = passes(job, longest * SubpathRecords.BYTES_RGB)
        images = [share * _derivative_image(part, prepare(part)) for share, part in parts]
    return sum(images[1:], images[0])


def backward(job: Job, prepare: Prepare, longest: int, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; the transpose of `forward`, same samples."""
    if longest < 1:
        return
    with dr.suspend_grad():
        for share, part in passes(job, longest * SubpathRecords.BYTES_RGB):
            _accumulate_adjoint(part, prepare(part), share * grad_in)


def _derivative_image(job: Job, s: BoundarySamples | None) -> mi.TensorXf:
    """One pass of `forward`."""
    if s is None:
        return films.black(job.film)
    if job.trial is not None:
        return _splat(job, s, job.rejected.keep_finite(mi.Color1f(_trial_motion(job.trial, s))).x)
    with dr.resume_grad():
        m = _motion(job, s)
        grads = tangents(m.segment, m.connect, m.go_on, m.camera)
    at_edge, connect, go_on, camera = grads
    motion = dr.gather(mi.Float, at_edge, s.records.lane_of()) + s.records.before(go_on) + connect + camera
    return _splat(job, s, job.rejected.keep_finite(mi.Color1f(motion)).x)


def _accumulate_adjoint(job: Job, s: BoundarySamples | None, grad_in: mi.TensorXf) -> None:
    """One pass of `backward`."""
    if s is None:
        return
    with dr.resume_grad():
        motion = dr.zeros(mi.Float, s.records.lanes * s.records.depth)
        dr.enable_grad(motion)
        backpropagate(_splat(job, s, motion), grad_in)
        δ = dr.grad(motion)
    δ = job.rejected.keep_finite(mi.Color1f(δ)).x
    after = s.records.after(δ)
    total = s.records.total(δ, after)
    with dr.resume_grad():
        m = _motion(job, s)
        accumulate(dr.sum(total * m.segment) + dr.sum(δ * (m.connect + m.camera) + after * m.go_on))
