"""Light of points by way of mirrors and smooth glass: paths that only the light finds, differentiated from its side.

From the camera nothing leads back to a point through a delta lobe, so the camera-side flow of all other paths cannot
be theirs. Here a path y_0, y_1, …, y_s keeps its first vertex y_1 where it is on its surface, and the directions in
which it leaves smooth surfaces; at delta lobes the direction follows (`paths/delta_step.py`), vertices slide along
their rays, and the last one, y_s, is seen at a film position p that moves. A pixel with the filter h is

    I = ∫ h(p) V dA_1 …,        V = E(y_1) cosθ_1 Π_k w_k,        dI = ∫ [ V ∇h·ṗ + h V̇ ] dA_1 …

E is the light's irradiance perpendicular to the first segment, w_k the value of a delta lobe, of a smooth BSDF with
Veach's correction for particles, and at y_s that over the area J that a pixel sees; V̇ is V times the sum of their
relative derivatives, and that of |dA_1|. How light crowds on a receiver is not in V: splats that move apart or together
make it, and no Jacobian of the chain is needed. The price is that h is smooth; a box filter has no ∇h.

As y_1 stays, the outline of a body as the light sees it is no discontinuity: E cosθ_1 goes to 0 there, and a sheet
keeps its edge. The camera moves as if everything else moved the other way; what else changes J, such as the field of
view, is a factor of its own (`footprint`).

Not in here: that something else comes between the light and y_1, that a later vertex goes past an edge, and that y_s
goes behind something that hides it from the camera: `boundary/light_chain.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate, tangents
from ..core.records import Hit
from ..core.sensor_frame import look_at
from ..core.varying import varying
from ..errors import UnsupportedError
from ..paths.bounce import PathLimits, particle_eval
from ..paths.delta_step import delta_step
from ..paths.edge_on import met_edge_on
from ..paths.light_source import LightStart
from ..paths.light_walk import LightPath
from ..paths.rays import interaction
from ..plan.job import Job
from ..plan.motion import Displacements
from .flow import material_segment
from .subpaths import Subpaths, met_from


class ParticleRecords:
    """Hits of paths in the order in which the light meets them, vertex-major. A plain class: never loop state."""

    def __init__(self, lanes: int, depth: int):
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.hits = Hit.made(dr.empty, lanes * depth)
        self.delta = dr.empty(mi.Bool, lanes * depth)
        self.count = mi.UInt32(0)  # vertices, per lane

    def write(self, k: mi.UInt32, hit: Hit, delta: mi.Bool, active: mi.Bool) -> None:
        index = k * self.stride + self.lane
        dr.scatter(self.hits, hit, index, active, mode=dr.ReduceMode.Permute)
        dr.scatter(self.delta, delta, index, active, mode=dr.ReduceMode.Permute)

    def vertex(self, k: mi.UInt32, active: mi.Bool) -> tuple[Hit, mi.Bool]:
        """Vertex `k`, and whether it is left by a delta lobe."""
        index = k * self.stride + self.lane
        return dr.gather(Hit, self.hits, index, active), dr.gather(mi.Bool, self.delta, index, active)


@dataclass(frozen=True)
class LightBorne:
    """Such paths of one pass; host object."""

    job: Job
    records: ParticleRecords
    path: LightPath
    start: LightStart
    value: mi.Spectrum  # V over the density of the path, per lane
    wavelengths: mi.Color0f


@dataclass
class _Terms:
    """What a vertex hands on, attached."""

    x: mi.Point3f
    d: mi.Vector3f  # direction in which the next vertex is met
    w: mi.Spectrum  # its factor, relative to what it is
    p: mi.Point2f  # film position of the last vertex [px]


def record(
    job: Job, path: LightPath, start: LightStart, subpath: Subpaths, limits: PathLimits, value: mi.Spectrum, depth: int
) -> LightBorne:
    """Write the paths down. `value`: what they are worth. Detached. Raises where the film cannot show how they move."""
    if job.facts.geometry_moves and job.film.rfilter().is_box_filter():
        raise UnsupportedError(
            "light of points by way of mirrors and smooth glass moves over the film, in jumps with a box filter: "
            'use a smooth reconstruction filter, <rfilter type="gaussian"/>, or light_paths="off", which leaves that '
            "light out"
        )
    records = ParticleRecords(dr.width(path.p), depth)
    sound = _write(path, start, subpath, limits, records)
    records.count = dr.select(sound, path.count, 0)
    dr.eval(records.count, records.hits, records.delta)
    if job.facts.geometry_moves:
        job.call.counters.grazing.count(~sound)
    return LightBorne(job, records, path, start, value, start.ray.wavelengths)


@dr.syntax
def _write(path: LightPath, start: LightStart, subpath: Subpaths, limits: PathLimits, records: ParticleRecords):
    """Returns the lanes that meet no vertex edge-on."""
    n = mi.UInt32(path.count)
    k = mi.UInt32(0)
    o = mi.Point3f(start.ray.o)
    sound = mi.Bool(n > 0)
    active = mi.Bool(n > 0)
    while dr.hint(active, label="psdr.light_borne.write", exclude=[path, start, subpath, limits]):
        here = subpath.vertex(k, active)
        hit = met_from(o, here)
        si = interaction(hit.intersection(), mi.Ray3f(o, hit.d, 0, start.ray.wavelengths), limits)
        sound &= ~met_edge_on(si, hit.d)
        last = k + 1 == n
        records.write(k, hit, here.delta & ~last, active)
        following = subpath.vertex(k + 1, active & ~last)
        o = mi.Point3f(si.spawn_ray_to(following.x).o)
        k += 1
        active = k < n
    return sound


def _relative(w: mi.Spectrum) -> mi.Spectrum:
    """w/w: 1, with the relative derivative of w; channels that are black have none."""
    value = dr.detach(w)
    return dr.select(value != 0, w / dr.select(value != 0, value, 1), 0)


def _leave(found: LightBorne, moves: Displacements) -> tuple[mi.Point3f, mi.Vector3f, mi.Spectrum]:
    """Origin on the light, direction to y_1, and E cosθ_1 |dA_1| over the pixel, relative to what it is. Attached."""
    active = found.records.count > 0
    hit, _ = found.records.vertex(mi.UInt32(0), active)
    emitter = dr.reinterpret_array(mi.EmitterPtr, found.start.emitter)
    o = mi.Point3f(found.start.y + moves.of_light_start(emitter, hit, active))
    lit, d, measure = material_segment(o, hit, found.wavelengths, moves, active)
    projected = measure * dr.relative_grad(dr.squared_norm(lit.p - o))  # cosθ_1 |dA_1|
    if found.job.facts.camera_moves:
        projected /= moves.footprint(found.job.frame.kind, found.path.film, found.path.aperture)
    lit.p = lit.p - moves.of_lights()
    _, E = emitter.sample_direction(lit, mi.Point2f(0.5), active)
    return o, d, _relative(E) * projected


def _terms(found: LightBorne, k: mi.UInt32, ray: mi.Ray3f, moves: Displacements, active: mi.Bool) -> _Terms:
    """Vertex `k`, met by the attached `ray`."""
    job, path = found.job, found.path
    last = k + 1 == found.records.count
    hit, delta = found.records.vertex(k, active)
    onward, _ = found.records.vertex(k + 1, active & ~last)
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    si = moves.surface(hit, ray, mi.RayFlags.All)
    bsdf = si.bsdf()
    # the sensor is left where it is, and what it sees moves the other way
    x = mi.Point3f(si.p - moves.of_camera(path.film, path.aperture, dr.detach(si.p)))  # a difference is a vector
    view = look_at(job.frame, x, path.aperture)
    seen = view.ω + moves.of_view(path.film, path.aperture, dr.detach(view.ω))
    wo = dr.select(last, -seen, onward.d)
    w = particle_eval(si, bsdf, wo, active & ~delta)
    w = dr.select(last, w / view.J_px, w)
    step = delta_step(ctx, si, bsdf, onward.d, active & delta)
    d = dr.select(delta, step.d, onward.d)
    return _Terms(si.p, d, _relative(dr.select(delta, step.value, w)), view.p)


@dr.syntax
def _forward_sweep(found: LightBorne, o_grad: mi.Vector3f, d_grad: mi.Vector3f, rate: mi.Spectrum):
    """`(V̇/V, ṗ)`, given the tangents of the first ray and the relative one of what it carries. Detached."""
    motion, records = found.job.motion, found.records
    k = mi.UInt32(0)
    rate = mi.Spectrum(rate)
    o_grad = mi.Vector3f(o_grad)
    d_grad = mi.Vector3f(d_grad)
    p_grad = mi.Vector2f(0)
    active = k < records.count
    while dr.hint(active, label="psdr.light_borne.forward", exclude=[found, motion]):
        hit, _ = records.vertex(k, active)
        o, d = mi.Point3f(hit.o), mi.Vector3f(hit.d)
        with motion.attached(o, d) as moving:
            dr.set_grad(o, o_grad)
            dr.set_grad(d, d_grad)
            t = _terms(found, k, mi.Ray3f(o, d, 0, found.wavelengths), moving, active)
            w_grad, x_grad, onward_grad, film_grad = tangents(t.w, t.x, t.d, t.p)
        rate = mi.Spectrum(rate + w_grad)
        o_grad = mi.Vector3f(x_grad)
        d_grad = mi.Vector3f(onward_grad)
        p_grad = mi.Vector2f(film_grad)
        k += 1
        active = k < records.count
    return rate, p_grad


@dr.syntax
def _backward_sweep(found: LightBorne, δrate: mi.Spectrum, δp: mi.Vector2f):
    """Accumulate ⟨δrate, V̇/V⟩ + ⟨δp, ṗ⟩; returns the adjoints of the first ray."""
    motion, records = found.job.motion, found.records
    k = mi.UInt32(records.count)
    λ_o = mi.Vector3f(0)
    λ_d = mi.Vector3f(0)
    λ_p = mi.Vector2f(δp)
    active = k > 0
    while dr.hint(active, label="psdr.light_borne.backward", exclude=[found, motion]):
        k -= 1
        hit, _ = records.vertex(k, active)
        o, d = mi.Point3f(hit.o), mi.Vector3f(hit.d)
        with motion.attached(o, d) as moving:
            t = _terms(found, k, mi.Ray3f(o, d, 0, found.wavelengths), moving, active)
            dr.backward_from(dr.sum(δrate * t.w) + dr.dot(λ_o, t.x) + dr.dot(λ_d, t.d) + dr.dot(λ_p, t.p))
            λ_o = mi.Vector3f(dr.grad(o))
            λ_d = mi.Vector3f(dr.grad(d))
        λ_p = mi.Vector2f(0)
        active = k > 0
    return λ_o, λ_d


def _splat(found: LightBorne, p: mi.Point2f, value: mi.Spectrum) -> mi.TensorXf:
    """Image of the paths; attached where `p` and `value` are."""
    return films.develop_splats(found.job.film, p, value, found.wavelengths, found.records.count > 0)


def forward(found: LightBorne) -> mi.TensorXf:
    """Derivative image. Detached."""
    with found.job.motion.attached() as moving:
        first = tangents(*_leave(found, moving))
    rate, p_grad = _forward_sweep(found, *first)
    rejected = found.job.call.counters.rejected
    V_grad = rejected.keep_finite(found.value * rate)
    p_grad = rejected.keep_finite(p_grad)
    with dr.resume_grad():
        p, value = mi.Point2f(found.path.p), mi.Spectrum(found.value)
        dr.enable_grad(p, value)
        dr.set_grad(value, V_grad)
        dr.set_grad(p, p_grad)
        image = _splat(found, p, value)
        image_grad = tangents(image)
    films.clear(found.job.film)
    return image_grad


def backward(found: LightBorne, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters."""
    with dr.resume_grad():
        p, value = mi.Point2f(found.path.p), mi.Spectrum(found.value)
        dr.enable_grad(p, value)
        backpropagate(_splat(found, p, value), grad_in)
        δrate, δp = dr.grad(value) * dr.detach(value), dr.grad(p)
    films.clear(found.job.film)
    rejected = found.job.call.counters.rejected
    δrate, δp = rejected.keep_finite(δrate), rejected.keep_finite(δp)
    λ_o, λ_d = (rejected.keep_finite(λ) for λ in _backward_sweep(found, δrate, δp))
    with found.job.motion.attached() as moving:
        o, d, carried = _leave(found, moving)
        accumulate(dr.dot(λ_o, o) + dr.dot(λ_d, d) + dr.sum(δrate * carried))
