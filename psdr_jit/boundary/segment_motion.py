"""The secondary boundary terms, from top to bottom: sample, trace, evaluate, splat; and their derivatives.

A term says how its lines are sampled, how their ends are found and what they are worth (`SecondaryTerm`); everything
else is written once, here. Each connection of a recorded sensor subpath has a value W (detached) and a motion
(attached, primal value 0):

    M_k = n_⊥·v_B + source + Σ_{j<k} g_j^continue·v_j + g_k^connect·v_k + (what is left)·camera ray

Forward mode takes the tangent of every summand at once and sums along the subpath; backward mode turns the film's
adjoint into one weight per summand by suffix sums. Neither traces a ray, and both are exact transposes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate, tangents
from ..core.line_guide import Drawn
from ..edges.location import EdgeLocation
from ..plan.job import Job, passes
from ..plan.motion import Displacements, Motion
from ..sampling.rows import SampledRows
from .sensor_subpath import SubpathRecords

E = TypeVar("E", bound=SampledRows)
L = TypeVar("L")
S = TypeVar("S")


class Segment(Protocol):
    """What segments towards lights have in common, whatever brings the step. Lanes."""

    at: EdgeLocation
    ω: mi.Vector3f
    n_perp: mi.Vector3f
    wavelengths: mi.Color0f


def source_rests(moving: Displacements) -> mi.Float:
    """The `source_motion` of segments whose far end does not matter."""
    return mi.Float(0)


@dataclass(frozen=True)
class BoundarySamples:
    """Boundary segments with their sensor subpaths. Lanes: segments; flat: vertex-major connections."""

    at: EdgeLocation  # x_B
    ω: mi.Vector3f  # of the segment's line
    n_perp: mi.Vector3f
    wavelengths: mi.Color0f
    records: SubpathRecords
    value: mi.Spectrum  # flat: splatted per unit of motion
    source_motion: Callable[[Displacements], mi.Float]  # attached, per lane, primal value 0
    drawn: Drawn | None = None  # how the lines were chosen, if they can be guided

    @staticmethod
    def of(
        segment: Segment,
        records: SubpathRecords,
        value: mi.Spectrum,
        source_motion: Callable[[Displacements], mi.Float] = source_rests,
        drawn: Drawn | None = None,
    ) -> BoundarySamples:
        return BoundarySamples(
            segment.at, segment.ω, segment.n_perp, segment.wavelengths, records, value, source_motion, drawn
        )


@dataclass(frozen=True)
class SecondaryTerm(Generic[E, L, S]):
    """How one secondary boundary is estimated. Every step is detached."""

    edges: Callable[[Job], E | None]  # what it samples; None: nothing can contribute
    longest: Callable[[Job], int]  # vertices of the longest sensor subpath; < 1: there is nothing to estimate
    sample: Callable[[Job, E], L]  # lines through edge points
    trace: Callable[[Job, E, L], S | None]  # those that end where they should, with their ends
    evaluate: Callable[[Job, E, S], BoundarySamples]  # what they are worth


@dataclass
class _Motion:
    """Attached scalars of primal value 0."""

    segment: mi.Float  # per lane
    connect: mi.Float  # flat
    go_on: mi.Float
    camera: mi.Float


def _motion(job: Job, edges: SampledRows, s: BoundarySamples, moving: Displacements) -> _Motion:
    at_edge = dr.dot(s.n_perp, moving.of_edge(edges.table, s.at, s.ω)) + s.source_motion(moving)
    c = s.records.data
    surface = moving.of_surface(c.hit)
    camera = mi.Float(0)
    if job.facts.view_moves:
        camera = dr.dot(c.camera, moving.of_camera(c.film, c.aperture, c.hit.o + c.hit.d * c.hit.t))
    go_on = dr.dot(c.deposit_continue, surface)
    if s.records.delta is not None:
        go_on += s.records.delta.motion(c.hit, moving)
        if job.orbits is not None:
            go_on += s.records.delta.ball_motion(c.hit, moving, job.orbits)
    return _Motion(at_edge, dr.dot(c.deposit_connect, surface), go_on, camera)


def _splat(job: Job, s: BoundarySamples, motion: mi.Float) -> mi.TensorXf:
    c = s.records.data
    wavelengths = s.wavelengths
    if mi.is_spectral:
        wavelengths = dr.gather(type(wavelengths), wavelengths, s.records.lane_of())
    landed = dr.any(s.value != 0)
    return films.develop_boundary(job.film, c.p, s.value * motion, mi.Float(0), wavelengths, landed)


def forward(job: Job, term: SecondaryTerm) -> mi.TensorXf:
    """Derivative image along the tangents set on the scene's parameters, in passes that fit into memory. Detached."""
    longest = term.longest(job)
    if longest < 1:
        return films.black(job.film)
    with dr.suspend_grad():
        parts = passes(job, longest * SubpathRecords.BYTES_RGB)
        images = [share * _derivative_image(part, term) for share, part in parts]
    return sum(images[1:], images[0])


def backward(job: Job, term: SecondaryTerm, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; the transpose of `forward`, same samples."""
    longest = term.longest(job)
    if longest < 1:
        return
    with dr.suspend_grad():
        for share, part in passes(job, longest * SubpathRecords.BYTES_RGB):
            _accumulate_adjoint(part, term, share * grad_in)


def _samples(job: Job, term: SecondaryTerm) -> tuple[SampledRows, BoundarySamples] | None:
    """Sampled, traced and evaluated; None if nothing is left."""
    edges = term.edges(job)
    if edges is None:
        return None
    segments = term.trace(job, edges, term.sample(job, edges))
    if segments is None:
        return None
    s = term.evaluate(job, edges, segments)
    if job.learns:
        edges.rows.learn(edges.state, s.at.row, s.at.t, lambda: _worth(s))
    return edges, s


def _worth(s: BoundarySamples) -> mi.Float:
    """What each segment brings to the film per unit of motion, over its density. Per lane."""
    per_vertex = dr.max(dr.abs(s.value))
    return s.records.total(per_vertex, s.records.after(per_vertex))


def _derivative_image(job: Job, term: SecondaryTerm) -> mi.TensorXf:
    """One pass of `forward`."""
    found = _samples(job, term)
    if found is None:
        return films.black(job.film)
    edges, s = found
    motion = job.call.counters.rejected.keep_finite(mi.Color1f(_speed(job, edges, s, job.motion))).x
    if job.tally is not None and s.drawn is not None:
        job.tally.add(s.drawn, s.records.lane_of(), dr.max(dr.abs(s.value)) * motion, job.spp)
    return _splat(job, s, motion)


def _speed(job: Job, edges: SampledRows, s: BoundarySamples, motion: Motion) -> mi.Float:
    """How fast every connection moves (flat), as `motion` has it. Detached."""
    with motion.attached() as moving:
        m = _motion(job, edges, s, moving)
        at_edge, connect, go_on, camera = tangents(m.segment, m.connect, m.go_on, m.camera)
    return dr.gather(mi.Float, at_edge, s.records.lane_of()) + s.records.before(go_on) + connect + camera


def _accumulate_adjoint(job: Job, term: SecondaryTerm, grad_in: mi.TensorXf) -> None:
    """One pass of `backward`."""
    found = _samples(job, term)
    if found is None:
        return
    edges, s = found
    with dr.resume_grad():
        motion = dr.zeros(mi.Float, s.records.lanes * s.records.depth)
        dr.enable_grad(motion)
        backpropagate(_splat(job, s, motion), grad_in)
        δ = dr.grad(motion)
    δ = job.call.counters.rejected.keep_finite(mi.Color1f(δ)).x
    if job.tally is not None and s.drawn is not None:
        job.tally.add(s.drawn, s.records.lane_of(), δ * _speed(job, edges, s, job.probe), job.spp)
    after = s.records.after(δ)
    total = s.records.total(δ, after)
    with job.motion.attached() as moving:
        m = _motion(job, edges, s, moving)
        accumulate(dr.sum(total * m.segment) + dr.sum(δ * (m.connect + m.camera) + after * m.go_on))
