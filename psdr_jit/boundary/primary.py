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

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import backpropagate, tangents
from ..core.low_discrepancy import lane_sampler
from ..core.sensor_frame import SensorFrame
from ..core.streams import Stream, stream_seed
from ..edges.location import EdgeLocation
from ..edges.points import VISIBILITY_EPSILON, EdgePoint, curve_row_point, segment_point
from ..edges.table import (
    EdgeTable,
    compact,
    edge_samples,
    scene_edges,
    shared_frame,
    sides,
)
from ..options import Options
from ..paths.walk import NoSink, skip_emitters, walk
from ..plan.job import Job
from ..plan.plan import Geometry
from ..plan.reasons import steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling import film_weights
from ..sampling.distribution import EdgeDistribution, distribution_of, pmf, sample_edge, stratified
from ..scene.facts import SceneFacts


@dataclass(frozen=True)
class PrimaryEdges:
    """What can be seen to move, and the density with which it is sampled."""

    table: EdgeTable
    distribution: EdgeDistribution


@dataclass
class EdgeSample:
    """What is kept of an edge sample between kernels (detached)."""

    row: mi.UInt32
    t: mi.Float
    aperture: mi.Point2f
    inv_pdf: mi.Float  # 1 / (pmf of the row · number of samples)
    lane: mi.UInt32


def primary_edges(job: Job, frame: SensorFrame) -> PrimaryEdges | None:
    """Edges that can move on the film: of moving shapes, or of all if the camera moves. None: nothing can."""
    table = scene_edges(job)
    border = job.film.rfilter().border_size() if job.film.sample_border() else 0
    weights = []
    if table.has_segments:
        weights.append(film_weights.segment_weights(table.segments, frame, border))
    if table.has_curves:
        weights.append(film_weights.curve_weights(table.curves, frame, border))
    if not job.facts.camera_moves and job.plan.prunes:
        weights = [dr.select(rests, 0, w) for w, rests in zip(weights, table.rests, strict=True)]
    distribution = distribution_of(weights)
    return None if distribution is None else PrimaryEdges(table, distribution)


def edge_weights(job: Job) -> mi.Float | None:
    """Density of edge samples by row of the edge table, not normalised; None if there is none."""
    edges = primary_edges(job, shared_frame(job))
    return None if edges is None else edges.distribution.weight


@dataclass
class _Seen:
    """An edge point of either table, with what only one of them needs."""

    point: EdgePoint
    straight: mi.Bool
    local: mi.Point3f  # curves: material point
    scale: mi.Float  # curves: size of the shape


def _edge_point(edges: PrimaryEdges, sample: EdgeSample, frame: SensorFrame) -> _Seen:
    straight = sample.row < edges.table.segment_count
    local, scale, point = mi.Point3f(0), mi.Float(0), None
    if edges.table.has_segments:
        point = segment_point(edges.table.segments, sample.row, sample.t, frame, sample.aperture, straight)
    if edges.table.has_curves:
        row = sample.row - edges.table.segment_count
        on_curve, local, scale = curve_row_point(edges.table.curves, row, sample.t, frame, sample.aperture, ~straight)
        point = on_curve if point is None else dr.select(straight, point, on_curve)
    return _Seen(point, straight, local, scale)


def sample_visible(job: Job, frame: SensorFrame, edges: PrimaryEdges) -> EdgeSample:
    """Stratified samples on the edges; those that the sensor does not see are left out (their value is 0)."""
    lower, upper = frame.window
    count = edge_samples(job, frame, paths=2)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.PRIMARY_EDGE), lane)
    row, t = sample_edge(edges.distribution, stratified(count, rng.next_1d()))
    aperture = rng.next_2d() if frame.kind == "thinlens" else mi.Point2f(0.5)
    sample = EdgeSample(row, t, aperture, dr.rcp(pmf(edges.distribution, row) * dr.opaque(mi.Float, count)), lane)

    seen = _edge_point(edges, sample, frame)
    view, p = seen.point.view, seen.point.view.p
    inside = (p.x >= lower[0]) & (p.x < upper[0]) & (p.y >= lower[1]) & (p.y < upper[1])
    active = seen.point.valid & inside
    # A ray aimed at a tangent point meets the shape itself: aim beside it.
    aim = seen.point.x + dr.select(seen.straight, 0, VISIBILITY_EPSILON * seen.scale) * seen.point.side
    direction = aim - view.o
    distance = dr.norm(direction)
    ray = mi.Ray3f(view.o, direction / distance)
    ray.maxt = distance * (1 - VISIBILITY_EPSILON)
    blocked = job.scene.ray_test(ray, active)
    if job.options.hide_emitters:
        pi = job.scene.ray_intersect_preliminary(ray, active=active)
        _, pi = skip_emitters(job.scene, ray, pi)
        blocked = pi.is_valid()
    return compact(sample, active & ~blocked)


def _both_sides(job: Job, frame: SensorFrame, edges: PrimaryEdges, sample: EdgeSample):
    """Radiance and coverage on the − and + side of every sample: `(L, alpha, wavelengths, differs)`, 2 lanes each."""
    n = dr.width(sample.row)
    index = dr.arange(mi.UInt32, 2 * n)
    which, s = index & 1, dr.gather(EdgeSample, sample, index >> 1)
    seen = _edge_point(edges, s, frame)
    rng = lane_sampler(stream_seed(job.seed, Stream.PRIMARY_RADIANCE), s.lane)
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    ray, pi, differs = sides(job.scene, edges.table, s.row, s.t, seen.point, seen.scale, which, wavelengths)
    emission = mi.Bool(True)
    if job.options.hide_emitters:
        ray, pi = skip_emitters(job.scene, ray, pi)
        emission = mi.Bool(False)
    L, _, surface = walk(job.scene, rng, ray, pi, job.limits, NoSink(), emission, differs)
    L *= weight
    sky = job.scene.environment() is not None and not job.options.hide_emitters
    alpha = mi.Float(1) if sky else dr.select(surface, mi.Float(1), 0)
    alpha += dr.zeros(mi.Float, 2 * n)  # full width, whatever it is made of
    dr.eval(L, alpha, wavelengths)
    return L, alpha, wavelengths


def _contribution(job: Job, finish: Callable[[mi.TensorXf], mi.TensorXf | None]) -> mi.TensorXf | None:
    """`finish(image)`, the boundary as an image of value 0 that carries its derivative; None if there is nothing."""
    frame = shared_frame(job)
    with dr.suspend_grad():
        edges = primary_edges(job, frame)
        if edges is None:
            return None
        sample = sample_visible(job, frame, edges)
        if dr.width(sample.row) == 0:
            return None
        L, alpha, wavelengths = _both_sides(job, frame, edges, sample)
        even = 2 * dr.arange(mi.UInt32, dr.width(sample.row))
        step = dr.gather(mi.Spectrum, L, even) - dr.gather(mi.Spectrum, L, even + 1)
        ΔL = job.call.counters.rejected.keep_finite(step)
        Δα = dr.gather(mi.Float, alpha, even) - dr.gather(mi.Float, alpha, even + 1)
        wavelengths = dr.gather(type(wavelengths), wavelengths, even) if mi.is_spectral else wavelengths
        seen = _edge_point(edges, sample, frame)
        point = seen.point
        scale = point.speed / point.view.J_px * sample.inv_pdf

    with job.motion.attached() as moving:
        at = EdgeLocation(sample.row, sample.t, point.x, seen.local, seen.scale)
        relative = moving.of_edge(edges.table, at)
        if job.facts.camera_moves:
            relative -= moving.of_camera(point.view.film, sample.aperture, point.x)
        motion = dr.dot(point.side, relative) * scale
        p = point.view.p
        return finish(films.develop_boundary(job.film, p, ΔL * motion, Δα * motion, wavelengths, point.valid))


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the primary boundary along the tangents set on the scene's parameters. Detached."""
    image = _contribution(job, tangents)
    return films.black(job.film) if image is None else image


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the primary boundary's ⟨grad_in, dI⟩ into the attached parameters."""
    _contribution(job, lambda image: backpropagate(image, grad_in))


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Outlines move as soon as a shape or the camera does."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if not (facts.shapes_move or facts.camera_moves):
        return False, "only lights without a shape move: every outline stays where it is on the film"
    return True, "outlines move over the film"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    return 1.1


TERM = Term(
    name="primary",
    budget="sppp",
    streams=(Stream.PRIMARY_EDGE, Stream.PRIMARY_RADIANCE),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(edge_weights, "the others rest, are coplanar, turn away or leave the film"),
)
