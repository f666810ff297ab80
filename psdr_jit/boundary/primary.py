"""Primary boundary: discontinuities that the sensor sees directly, integrated over the film.

The film image is cut by the projections of edges. Moving edges sweep the film; with x_B on an edge, ω the direction
from the sensor to it and s = τ×ω/|τ×ω| the direction across the edge, the derivative of the image receives

    (L_− − L_+) · s·(v_B − u) · |dx/dt × ω| / J_px / pdf(t)         splatted at the projection of x_B,

L_∓ radiance on the side −s and +s, v_B the material velocity of the edge point, u that of the point at x_B's depth
on the viewing ray of a *fixed* film position (camera motion), and J_px the area perpendicular to ω that one pixel sees
there. It is the boundary integral of [Zhang et al. 2020, Eq. 21] restricted to the first segment, or the edge integral
of [Li et al. 2018, Eq. 5], written in world space: only x_B and the camera ray are attached, so pose, field of view,
principal point, aperture and focus need no code of their own.

The value of the estimator is 0, only its derivative is not. Both sides are traced with the same random numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate, tangents
from ..core.compaction import compact
from ..core.line_guide import Drawn
from ..core.low_discrepancy import lane_sampler
from ..core.sensor_frame import View, look_at, viewpoint
from ..core.streams import Stream, stream_seed
from ..edges.kind import Sight
from ..edges.location import EdgeLocation
from ..edges.table import look_beside
from ..options import Options
from ..paths.walk import NoSink, see_through_emitters, walk
from ..plan.job import Job
from ..plan.motion import Displacements, Motion
from ..plan.plan import Geometry
from ..plan.reasons import steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling.film_edges import FilmEdges, film_edges, film_weights
from ..sampling.guided import guided
from ..sampling.rows import edge_samples
from ..scene.facts import SceneFacts
from .edge_visibility import hidden

NAME = "primary"


@dataclass
class EdgeSample:
    """What is kept of an edge sample between kernels (detached)."""

    row: mi.UInt32
    t: mi.Float
    aperture: mi.Point2f
    pdf: mi.Float  # of row and t and by the guide, times the number of samples
    lane: mi.UInt32
    drawn: Drawn


@dataclass
class SeenEdge:
    """An edge point on the film; detached, one entry per sample."""

    sight: Sight
    view: View
    across: mi.Float  # length of edge seen per unit of its parameter, |dx/dt × ω| [m]
    valid: mi.Bool


@dataclass
class Steps:
    """Samples ready to be moved; detached, one entry each."""

    at: EdgeLocation
    ω: mi.Vector3f  # unit, from the sensor
    n_perp: mi.Vector3f
    turn: mi.Vector3f  # see `EdgeKind.turn`; 0 unless the camera moves
    p: mi.Point2f  # film position [px]
    film: mi.Point2f  # the same in [0, 1]² of the crop window
    aperture: mi.Point2f
    value: mi.Spectrum  # contribution per unit of motion
    alpha: mi.Float  # the same of the coverage
    wavelengths: mi.Color0f
    valid: mi.Bool
    drawn: Drawn


def seen_edge(job: Job, edges: FilmEdges, sample: EdgeSample) -> SeenEdge:
    """The edge points as the sensor sees them."""
    on = edges.table.on(sample.row, sample.t, viewpoint(job.frame, sample.aperture))
    view = look_at(job.frame, on.x, sample.aperture)
    n_perp, across = on.across(view.ω)
    sight = Sight.of(on, sample.row, sample.t, view.ω, view.r, n_perp)
    return SeenEdge(sight, view, across, on.valid & view.valid & (across > 0))


def sample_visible(job: Job, edges: FilmEdges) -> EdgeSample | None:
    """Stratified samples on the edges; those that the sensor does not see are left out (their value is 0)."""
    lower, upper = job.frame.window
    count = edge_samples(job, paths=2)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.PRIMARY_EDGE), lane)
    jitter = rng.next_1d()
    x, u, drawn = guided(job, count, jitter, rng.next_2d())
    row, t, pdf = edges.rows_at(x, count)
    aperture = u if job.frame.kind == "thinlens" else mi.Point2f(0.5)
    sample = EdgeSample(row, t, aperture, pdf * drawn.p, lane, drawn)

    seen = seen_edge(job, edges, sample)
    p = seen.view.p
    inside = (p.x >= lower[0]) & (p.x < upper[0]) & (p.y >= lower[1]) & (p.y < upper[1])
    active = seen.valid & inside
    return compact(sample, active & ~hidden(job, edges.table, seen.sight, active))


def trace_sides(job: Job, edges: FilmEdges, sample: EdgeSample):
    """Radiance and coverage on the − and + side of every sample: `(L, alpha, wavelengths)`, 2 lanes each."""
    n = dr.width(sample.row)
    index = dr.arange(mi.UInt32, 2 * n)
    which, s = index & 1, dr.gather(EdgeSample, sample, index >> 1)
    seen = seen_edge(job, edges, s)
    rng = lane_sampler(stream_seed(job.seed, Stream.PRIMARY_RADIANCE), s.lane)
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    ray, pi, differs = look_beside(job.scene, edges.table, seen.sight, which, wavelengths, coherent=True)
    pi.t = dr.select((job.frame.to_local @ ray(pi.t)).z < job.frame.far, pi.t, dr.inf)
    emission = mi.Bool(True)
    if job.options.hide_emitters:
        ray, pi = see_through_emitters(job.scene, ray, pi)
        emission = mi.Bool(False)
    limits = job.limits_beside.looking_within(edges.table.within_surfaces(s.row))
    L, _, surface = walk(job.scene, rng, ray, pi, limits, NoSink(), emission, differs)
    L *= weight
    alpha = mi.Float(1) if job.sky_is_seen else dr.select(surface, mi.Float(1), 0)
    alpha += dr.zeros(mi.Float, 2 * n)  # full width, whatever it is made of
    dr.eval(L, alpha, wavelengths)
    return L, alpha, wavelengths


def _steps(job: Job) -> tuple[FilmEdges, Steps] | None:
    """Everything about the samples but how fast they move; None if there are none."""
    edges = film_edges(job, NAME, lambda: film_weights(job))
    if edges is None:
        return None
    sample = sample_visible(job, edges)
    if sample is None:
        return None
    L, alpha, wavelengths = trace_sides(job, edges, sample)
    even = 2 * dr.arange(mi.UInt32, dr.width(sample.row))
    step = dr.gather(mi.Spectrum, L, even) - dr.gather(mi.Spectrum, L, even + 1)
    ΔL = job.call.counters.rejected.keep_finite(step)
    Δα = dr.gather(mi.Float, alpha, even) - dr.gather(mi.Float, alpha, even + 1)
    wavelengths = dr.gather(type(wavelengths), wavelengths, even) if mi.is_spectral else wavelengths
    seen = seen_edge(job, edges, sample)
    scale = per_motion(seen, sample)
    if job.learns:
        edges.rows.learn(edges.state, sample.row, sample.t, lambda: dr.max(dr.abs(ΔL)) * scale)
    return edges, steps_at(job, edges, seen, sample, (ΔL * scale, Δα * scale, wavelengths))


def per_motion(seen: SeenEdge, sample: EdgeSample) -> mi.Float:
    """What a step of 1 at the edge brings, per unit of its motion."""
    return seen.across / (seen.view.J_px * sample.pdf)


def steps_at(job: Job, edges: FilmEdges, seen: SeenEdge, sample: EdgeSample, values: tuple) -> Steps:
    """Samples ready to be moved; `values`: (contribution, coverage, wavelengths)."""
    sight, view = seen.sight, seen.view
    turn = edges.table.turn(sight.at, view.ω, sight.n_perp) if job.facts.view_moves else mi.Vector3f(0)
    place = (view.p, view.film, sample.aperture)
    return Steps(sight.at, view.ω, sight.n_perp, turn, *place, *values, seen.valid, sample.drawn)


def motion_across(job: Job, edges: FilmEdges, steps: Steps, moving: Displacements) -> mi.Float:
    """How fast the edges move across the film, attached; value 0."""
    relative = moving.of_edge(edges.table, steps.at, steps.ω)
    if not job.facts.view_moves:
        return dr.dot(steps.n_perp, relative)
    relative -= moving.of_camera(steps.film, steps.aperture, steps.at.x)
    return dr.dot(steps.n_perp, relative) + dr.dot(steps.turn, moving.of_view(steps.film, steps.aperture, steps.ω))


def _splat(job: Job, steps: Steps, motion: mi.Float) -> mi.TensorXf:
    return films.develop_boundary(
        job.film, steps.p, steps.value * motion, steps.alpha * motion, steps.wavelengths, steps.valid
    )


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the primary boundary along the tangents set on the scene's parameters. Detached."""
    with dr.suspend_grad():
        found = _steps(job)
        if found is None:
            return films.black(job.film)
        edges, steps = found
        motion = _speed(job, edges, steps, job.motion)
        _tell(job, steps, dr.max(dr.abs(steps.value)) * motion)
        return _splat(job, steps, motion)


def _speed(job: Job, edges: FilmEdges, steps: Steps, motion: Motion) -> mi.Float:
    """How fast the edges move across the film, as `motion` has it. Detached."""
    with motion.attached() as moving:
        return tangents(motion_across(job, edges, steps, moving))


def _tell(job: Job, steps: Steps, contribution: mi.Float) -> None:
    """Let whoever listens know what every sample brings."""
    if job.tally is not None:
        lane = dr.arange(mi.UInt32, dr.width(steps.p))
        job.tally.add(steps.drawn, lane, dr.select(steps.valid, contribution, 0), job.spp)


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the primary boundary's ⟨grad_in, dI⟩ into the attached parameters."""
    with dr.suspend_grad():
        found = _steps(job)
        if found is None:
            return
        edges, steps = found
        λ = _adjoint(job, steps, grad_in)
        # Stored: each entry of a pose is a sum over all samples, in a kernel that would compute all this anew.
        dr.eval(λ, steps)
        if job.tally is not None:
            _tell(job, steps, λ * _speed(job, edges, steps, job.probe))
        with job.motion.attached() as moving:
            accumulate(λ * motion_across(job, edges, steps, moving))


def _adjoint(job: Job, steps: Steps, grad_in: mi.TensorXf) -> mi.Float:
    """Derivative of ⟨grad_in, image⟩ by the motion of every sample."""
    with dr.resume_grad():
        motion = dr.zeros(mi.Float, dr.width(steps.p))
        dr.enable_grad(motion)
        backpropagate(_splat(job, steps, motion), grad_in)
        return dr.grad(motion)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Outlines move as soon as a shape or the camera does."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if not (facts.shapes_move or facts.camera_moves):
        what = "paths bend behind glass" if facts.paths_bend else "lights without a shape move"
        return False, f"only {what}: every outline stays where it is on the film"
    return True, "outlines move over the film"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    return 1.1


TERM = Term(
    name=NAME,
    budget="sppp",
    streams=(Stream.PRIMARY_EDGE, Stream.PRIMARY_RADIANCE),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(film_weights, "the others rest, are coplanar, turn away or leave the film"),
    guided=1,
    covers=True,
)
