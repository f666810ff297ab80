"""The interior term's paths that light subpaths find: turned around, and differentiated as any other.

How a path is found and how it flows are two things. The derivative of what all techniques find together is

    dI = Σ_t E[ w_t V_t D(x̄) ]

V_t the contribution over the density of technique t, w_t its weight, both detached, D the relative derivative of the
integrand along *our* flow, which is the same for every t. So a path from the light (`paths/light_walk.py`) is written
down as the camera would have met it, and goes through the sweeps (`sweeps.py`) that all paths go through. Its film
point is where the sensor sees x_1 now, and stays fixed while θ changes, or goes where all places there do
(`film_places.py`): the attached camera ray through it moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate
from ..core.camera_rays import RayNumbers, RayPerPixel, ray_per_pixel
from ..core.low_discrepancy import lane_sampler
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..paths.bounce import PathLimits
from ..paths.light_source import LightStart
from ..paths.light_vertices import LightVertices
from ..paths.light_walk import LightPath, trace_light
from ..paths.recording import PathRecords
from ..plan.job import Job
from . import film_places, light_borne
from .flow import Flow
from .light_borne import LightBorne
from .subpaths import Subpaths
from .sweeps import backward_sweep, forward_sweep
from .turning import turn_around


@dataclass(frozen=True)
class LightTraced:
    """Paths of one pass that light subpaths have found; host object. `borne`: those that nothing else finds."""

    turned: TurnedPaths | None
    borne: LightBorne | None


@dataclass(frozen=True)
class TurnedPaths:
    """Paths that camera paths find as well."""

    records: PathRecords
    path: LightPath
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths, over the number of subpaths
    per_px: RayPerPixel | None  # of the sensor's rays, where film positions move


def find_paths(job: Job, seed: mi.UInt32, spp: int, limits: PathLimits) -> LightTraced | None:
    """Trace the light subpaths that go with `spp` camera samples per pixel; None if none of them reaches the sensor."""
    technique, lanes = limits.light, job.plan.light.subpaths(job.frame, spp)
    rng = lane_sampler(stream_seed(seed, Stream.LIGHT_SUBPATH), dr.arange(mi.UInt32, lanes))
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    start = technique.sources.sample(rng, wavelengths)
    vertices = LightVertices(lanes, technique.longest)
    path = trace_light(job.scene, rng, start, limits, job.options.hide_emitters, vertices)
    found = path.scale > 0
    weight = mi.Spectrum(weight) / varying(mi.Float, lanes)
    dr.eval(path, start, wavelengths, weight, found, vertices.data)
    all_paths = _Found(path, start, wavelengths, weight, vertices)
    turned = _turned(job, all_paths, dr.compress(found & ~path.alone), limits)
    borne = None
    if technique.delta_lobes:
        borne = _borne(job, all_paths, dr.compress(found & path.alone), limits)
    return LightTraced(turned, borne)


@dataclass(frozen=True)
class _Found:
    """What light subpaths brought, all lanes; host object."""

    path: LightPath
    start: LightStart
    wavelengths: mi.Color0f
    weight: mi.Spectrum
    vertices: LightVertices

    def of(self, lane: mi.UInt32) -> tuple[LightPath, LightStart, mi.Color0f, mi.Spectrum]:
        """Path, start, wavelengths and their weight in these lanes."""
        path, start = (dr.gather(type(record), record, lane) for record in (self.path, self.start))
        wavelengths, weight = self.wavelengths, self.weight
        if mi.is_spectral:
            wavelengths, weight = (dr.gather(type(v), v, lane) for v in (wavelengths, weight))
        return path, start, wavelengths, weight


def _borne(job: Job, found: _Found, lane: mi.UInt32, limits: PathLimits) -> LightBorne | None:
    """Paths that only the light finds, as it meets them."""
    if dr.width(lane) == 0:
        return None
    path, start, _, weight = found.of(lane)
    subpaths = Subpaths(found.vertices, lane)
    job = job.with_film_at_rest()  # their own places on the film move as it is
    return light_borne.record(job, path, start, subpaths, limits, path.value * weight, limits.light.longest)


def _turned(job: Job, found: _Found, lane: mi.UInt32, limits: PathLimits) -> TurnedPaths | None:
    """The others, as the camera meets them."""
    if dr.width(lane) == 0:
        return None
    path, start, wavelengths, weight = found.of(lane)
    subpaths = Subpaths(found.vertices, lane)
    # a light that is met behind a delta lobe is a vertex of its own
    records = PathRecords(dr.width(lane), limits.light.longest + (1 if limits.light.delta_lobes else 0))
    sound = turn_around(job, path, start, subpaths, limits, records)
    records.count = dr.select(sound, records.count, 0)
    records.wavelengths = wavelengths
    dr.eval(sound, records.count, records.vertices)  # at once: what is read later would go over the paths again
    if job.facts.geometry_moves:
        job.call.counters.grazing.count(~sound)
    if job.close_by is not None:
        records.note_close_by(job.close_by)
    per_px = None
    if job.film_flow is not None:
        per_px = ray_per_pixel(job.sensor, path.p, RayNumbers(path.aperture, mi.Float(0), mi.Float(0.5)))
        dr.eval(per_px)
    return TurnedPaths(records, path, wavelengths, weight, per_px)


def _splat(job: Job, found: TurnedPaths, values: mi.Spectrum) -> mi.TensorXf:
    """Image of one value per path; attached where `values` are."""
    landed = found.records.count > 0
    return films.develop_boundary(job.film, found.path.p, values * found.weight, mi.Float(0), found.wavelengths, landed)


def _camera_ray(job: Job, found: TurnedPaths) -> mi.Ray3f:
    """The attached camera rays through the film points."""
    with dr.resume_grad():
        ray, _ = job.sensor.sample_ray(0, 0.5, found.path.film, found.path.aperture)
    return ray


def forward(job: Job, found: LightTraced, flow: Flow) -> mi.TensorXf:
    """Derivative image of the paths found. Detached."""
    image = films.black(job.film)
    if found.turned is not None:
        image += _forward(job, found.turned, flow)
    if found.borne is not None:
        image += light_borne.forward(found.borne)
    return image


def backward(job: Job, found: LightTraced, flow: Flow, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ of the paths found into the attached parameters."""
    if found.turned is not None:
        _backward(job, found.turned, flow, grad_in)
    if found.borne is not None:
        light_borne.backward(found.borne, grad_in)


def _moved(job: Job, found: TurnedPaths, L: mi.Spectrum) -> Callable[[], mi.TensorXf]:
    """The image of the radiance `L` of the paths, as their film points move."""
    value = job.call.counters.rejected.keep_finite(L) * found.weight
    return partial(film_places.of_splats, job, found.path.p, value, found.wavelengths, found.records.count > 0)


def _forward(job: Job, found: TurnedPaths, flow: Flow) -> mi.TensorXf:
    o_grad, d_grad = mi.Vector3f(0), mi.Vector3f(0)
    if job.facts.view_moves:
        o_grad, d_grad = film_places.camera_tangents(job, _camera_ray(job, found), found.path.p, found.per_px)
    dL, L = forward_sweep(found.records, o_grad, d_grad, flow, job.motion)
    image = _splat(job, found, job.call.counters.rejected.keep_finite(dL))
    if job.film_flow is not None:
        image += film_places.forward(job, _moved(job, found, L))
    return image


def _backward(job: Job, found: TurnedPaths, flow: Flow, grad_in: mi.TensorXf) -> None:
    with dr.resume_grad():
        values = dr.zeros(mi.Spectrum, found.records.lanes)
        dr.enable_grad(values)
        backpropagate(_splat(job, found, values), grad_in)
        δL = dr.grad(values)
    films.clear(job.film)
    λ_o, λ_d, L = backward_sweep(found.records, δL, flow, job.motion)
    if job.facts.view_moves:
        # stored, as in `term`: a pose asks for each of them twelve times
        dr.eval(λ_o, λ_d, *([] if job.film_flow is None else [L]))
        ray = _camera_ray(job, found)
        with dr.resume_grad():
            accumulate(film_places.camera_adjoint(job, ray, found.path.p, found.per_px, (λ_o, λ_d)))
    if job.film_flow is not None:
        film_places.backward(job, _moved(job, found, L), grad_in)
