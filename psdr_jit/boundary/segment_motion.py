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
from ..edges.location import EdgeLocation
from ..edges.table import EdgeTable
from ..plan.job import Job, passes
from ..plan.motion import Displacements
from .sensor_subpath import SubpathRecords


@dataclass(frozen=True)
class BoundarySamples:
    """Boundary segments with their sensor subpaths. Lanes: segments; flat: vertex-major connections."""

    table: EdgeTable
    at: EdgeLocation  # x_B
    n: mi.Vector3f  # n_⊥
    wavelengths: mi.Color0f
    records: SubpathRecords
    value: mi.Spectrum  # flat: splatted per unit of motion
    source_motion: Callable[[Displacements], mi.Float]  # attached, per lane, primal value 0


Prepare = Callable[[Job], "BoundarySamples | None"]


@dataclass
class _Motion:
    """Attached scalars of primal value 0."""

    segment: mi.Float  # per lane
    connect: mi.Float  # flat
    go_on: mi.Float
    camera: mi.Float


def _motion(job: Job, s: BoundarySamples, moving: Displacements) -> _Motion:
    at_edge = dr.dot(s.n, moving.of_edge(s.table, s.at)) + s.source_motion(moving)
    c = s.records.data
    surface = moving.of_surface(c.hit)
    camera = mi.Float(0)
    if job.facts.camera_moves:
        camera = dr.dot(c.camera, moving.of_camera(c.film, c.aperture, c.hit.o + c.hit.d * c.hit.t))
    return _Motion(at_edge, dr.dot(c.deposit_connect, surface), dr.dot(c.deposit_continue, surface), camera)


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
    with job.motion.attached() as moving:
        m = _motion(job, s, moving)
        grads = tangents(m.segment, m.connect, m.go_on, m.camera)
    at_edge, connect, go_on, camera = grads
    motion = dr.gather(mi.Float, at_edge, s.records.lane_of()) + s.records.before(go_on) + connect + camera
    return _splat(job, s, job.call.counters.rejected.keep_finite(mi.Color1f(motion)).x)


def _accumulate_adjoint(job: Job, s: BoundarySamples | None, grad_in: mi.TensorXf) -> None:
    """One pass of `backward`."""
    if s is None:
        return
    with dr.resume_grad():
        motion = dr.zeros(mi.Float, s.records.lanes * s.records.depth)
        dr.enable_grad(motion)
        backpropagate(_splat(job, s, motion), grad_in)
        δ = dr.grad(motion)
    δ = job.call.counters.rejected.keep_finite(mi.Color1f(δ)).x
    after = s.records.after(δ)
    total = s.records.total(δ, after)
    with job.motion.attached() as moving:
        m = _motion(job, s, moving)
        accumulate(dr.sum(total * m.segment) + dr.sum(δ * (m.connect + m.camera) + after * m.go_on))
