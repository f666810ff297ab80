"""The interior term as an image: camera rays → recorded paths → sweep → film (estimator: `sweeps.py`, `flow.py`).

Only paths that touch something differentiable have a derivative. When neither camera nor emitters are attached,
a cheap first walk without shadow rays finds those paths and only they are recorded; the rest contribute exactly 0.
Where that has turned out to be most of them, an integrator no longer looks.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi

from ..core.ad import accumulate
from ..core.memory import Slot
from ..core.streams import Stream
from ..edges.followed_lights import followed_lights
from ..options import Options
from ..paths.dry_walk import count_vertices, touches
from ..paths.edge_on import first_cosine
from ..paths.recording import PathRecords
from ..paths.scattering import UNIFORM_SHARE
from ..paths.smooth_lights import SmoothLights, has_smooth_lights
from ..paths.walk import PathLimits, first_hit, walk
from ..plan.job import Job
from ..plan.plan import Geometry
from ..plan.reasons import what_changes
from ..plan.term import Term, Verdict
from ..scene.facts import SceneFacts
from ..scene.registry import registry_table
from . import film_borders, film_places, light_traced
from .along_walk import MaterialTangents, RadianceTangents
from .camera_pass import CameraPass, camera_passes
from .flow import Flow, SceneTraits
from .material import MaterialFlow
from .resting import RestingFlow
from .spatial import SpatialFlow
from .sphere_rims import RimPass, SphereRims, with_rims
from .sweeps import backward_sweep, forward_sweep

#: What vertices do from the second on, by form: slide along their rays, or stay on their material; in the mixed one,
#: those of which records do not say that they slide.
FLOWS = {"spatial": SpatialFlow, "material": MaterialFlow, "mixed": MaterialFlow}

#: Share of the paths that had a derivative when they were looked for last, by an integrator.
TOUCHED_SHARE: Slot[float] = Slot(float)

#: Share of paths with a derivative from which looking for them costs more than it saves; the others contribute 0.
MOST_PATHS = 0.6


def every_path_differs(job: Job) -> bool:
    """True if even a path that meets no enabled shape has a derivative: camera and light reach everything."""
    facts = job.facts
    emission = any(e.pose or e.radiance for e in facts.emitters)
    return facts.camera_moves or emission or _area_lights_change(facts) or not job.plan.prunes


def _area_lights_change(facts: SceneFacts) -> bool:
    """May points of area lights move, or their normals turn?"""
    return any(s.is_emitter and (s.geometry or s.shading) for s in facts.shapes)


def touch_table(job: Job) -> mi.UInt32:
    """By shape registry index: 1 if scattering there depends on an enabled parameter."""
    shapes = job.facts.shapes
    return registry_table(job.scene, {s.index for s in shapes if s.geometry or s.shading or s.material})


def paths_rest(job: Job) -> bool:
    """Do all enabled parameters belong to BSDFs and to the emission of lights? Then no path changes, nor its frames."""
    facts = job.facts
    return job.plan.prunes and not (facts.geometry_moves or any(s.shading for s in facts.shapes))


def _limits(job: Job) -> PathLimits:
    facts = job.facts
    # Where albedo itself is differentiated, a throughput of 0 is a value like any other.
    material = any(s.material for s in facts.shapes)
    rough_glass = any(s.bsdf_flags & int(mi.BSDFFlags.GlossyTransmission) for s in facts.shapes)
    limits = replace(job.limits, end_black=not material, refuses=material and rough_glass, light=job.light)
    if job.critical is not None:
        light = None if job.light is None else replace(job.light, critical=job.critical.of_light())
        limits = replace(limits, critical=job.critical, light=light)
    return replace(limits, uniform_share=UNIFORM_SHARE) if facts.geometry_moves else limits


def _along_the_walk(job: Job, p: CameraPass) -> mi.Spectrum:
    """Derivative of every path's radiance by the materials and lights it meets, without records."""
    ray, pi, emission = first_hit(job.scene, mi.Ray3f(dr.detach(p.ray)), job.options.hide_emitters)
    sampler = p.sampler(dr.arange(mi.UInt32, p.samples.count))
    lights = any(e.radiance for e in job.facts.emitters)
    sink = (RadianceTangents if lights else MaterialTangents).zero(job.facts.has_delta_lobes, job.rough_plastic)
    walk(job.scene, sampler, ray, pi, _limits(job), sink, emission, mi.Bool(True))
    return job.call.counters.rejected.keep_finite(sink.dL)


def _record(job: Job, p: CameraPass | RimPass) -> tuple[PathRecords, mi.UInt32]:
    """Trace the paths of a pass that can have a derivative; returns their records and their lanes."""
    facts, limits = job.facts, _limits(job)
    if limits.max_depth == 0:
        return PathRecords(0, 0), mi.UInt32()
    ray = mi.Ray3f(dr.detach(p.ray))
    lane = dr.arange(mi.UInt32, p.count)
    dr.eval(ray, lane)

    looks = not (p.sought or every_path_differs(job))
    if looks and job.call.memory[TOUCHED_SHARE] < MOST_PATHS:
        sampler = p.sampler(lane)
        found = touches(job.scene, sampler, ray, limits, job.options.hide_emitters, touch_table(job))
        if job.film_flow is not None:
            found |= job.film_flow.may_move(p.p)
        lane = dr.compress(found)
        job.call.memory[TOUCHED_SHARE] = dr.width(lane) / dr.width(found)
        if dr.width(lane) == 0:
            return PathRecords(0, 0), lane
        ray = dr.gather(mi.Ray3f, ray, lane)

    depth = limits.max_depth
    if job.options.max_depth == -1:
        depth = count_vertices(job.scene, p.sampler(lane), ray, limits, job.options.hide_emitters)
    records = PathRecords(dr.width(lane), depth, first_cosine(job.sensor))
    ray, pi, emission = first_hit(job.scene, ray, job.options.hide_emitters)
    sampler = p.sampler(lane)
    dr.eval(sampler)  # for one kernel, whatever the samples are of
    _, records.count, _ = walk(
        job.scene, sampler, ray, pi, replace(limits, max_depth=depth), records, emission, mi.Bool(True)
    )
    records.wavelengths = ray.wavelengths
    dr.eval(records.count, records.vertices, records.whole)  # at once: what is read later would trace the paths again
    if facts.geometry_moves:
        job.call.counters.grazing.count(records.cut())
    if job.close_by is not None:
        records.note_close_by(job.close_by)
    return records, lane


def flow_of(job: Job) -> Flow:
    """How vertices move. Unless geometry, a light's pose or the camera depend on θ, they do not."""
    facts = job.facts
    smooth_lights = SmoothLights(job.scene, alone=job.light is None) if has_smooth_lights(facts) else None
    # a probe moves everything
    lights_rest = job.plan.prunes and job.learns and not (facts.emitters_move or _area_lights_change(facts))
    traits = SceneTraits(
        facts.has_delta_emitters, facts.has_delta_lobes, smooth_lights, job.surfaces, followed_lights(job), lights_rest,
        job.orbits, job.rough_plastic,
    )
    if not facts.geometry_moves and (job.plan.prunes or traits.delta_lobes):  # which no other flow knows
        return RestingFlow(job.scene, traits)
    return FLOWS[job.form](job.scene, traits)


def _skipped(job: Job, p: CameraPass | RimPass, records: PathRecords) -> mi.Float:
    """How far the recorded camera rays start beyond the sensor's own: behind hidden emitters, 0 otherwise [m]."""
    if not job.options.hide_emitters:
        return mi.Float(0)
    first = records.vertex(mi.UInt32(0), records.count > 0)
    return dr.dot(first.hit.o - dr.detach(p.ray.o), dr.detach(p.ray.d))


def _derivative(job: Job, p: CameraPass | RimPass) -> mi.TensorXf:
    """Derivative image of the paths of a pass, along the tangents set on the scene's parameters."""
    if paths_rest(job):
        return p.develop(job.film, _along_the_walk(job, p))
    records, lane = _record(job, p)
    dL = dr.zeros(mi.Spectrum, p.count)
    if dr.width(lane) == 0:
        return p.develop(job.film, dL)
    o_grad, d_grad = mi.Vector3f(0), mi.Vector3f(0)
    known = p if job.film_flow is None else p.of(lane)
    if job.facts.view_moves:
        o_grad, d_grad = film_places.camera_tangents(job, known.ray, known.p, known.per_px)
        o_grad = o_grad + _skipped(job, known, records) * d_grad
    recorded, L = forward_sweep(records, o_grad, d_grad, flow_of(job), job.motion)
    keep_finite = job.call.counters.rejected.keep_finite
    dr.scatter(dL, keep_finite(recorded), lane)
    if job.film_flow is None:
        dr.eval(dL)  # the splat reads it inside a recorded loop, where pending writes are not seen
        return p.develop(job.film, dL)
    L = keep_finite(L)
    dr.eval(dL, L)
    return p.develop(job.film, dL) + film_places.forward(job, partial(film_places.of_samples, job, known, records, L))


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the interior term along the tangents set on the scene's parameters. Detached."""
    image = 0
    with dr.suspend_grad():
        rims = None if paths_rest(job) else SphereRims.of(job)
        for p in camera_passes(job):
            for part in with_rims(rims, p):
                image += p.share * _derivative(job, part)
            found = _from_light(job, p)
            if found is not None:
                image += p.share * light_traced.forward(job, found, flow_of(job))
        if film_borders.matter(job):
            image += film_borders.forward(job)
    return image


def _from_light(job: Job, p: CameraPass) -> light_traced.LightTraced | None:
    """What light subpaths find, as many as there are camera samples."""
    return None if job.light is None else light_traced.find_paths(job, p.seed, p.samples.spp, _limits(job))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate the interior term's ⟨grad_in, dI⟩ into the attached parameters."""
    with dr.suspend_grad():
        rims = None if paths_rest(job) else SphereRims.of(job)
        for p in camera_passes(job):
            found = _from_light(job, p)
            if found is not None:
                light_traced.backward(job, found, flow_of(job), p.share * grad_in)
            for part in with_rims(rims, p):
                _accumulate_adjoint(job, part, p.share, grad_in)
        if film_borders.matter(job):
            film_borders.backward(job, grad_in)


def _accumulate_adjoint(job: Job, p: CameraPass | RimPass, share: float, grad_in: mi.TensorXf) -> None:
    """Accumulate what `share` of a pass adds to ⟨grad_in, dI⟩."""
    records, lane = _record(job, p)
    if dr.width(lane) == 0:
        return
    δL = dr.gather(mi.Spectrum, share * p.adjoint(job.film, grad_in), lane)
    p = p if job.film_flow is None else p.of(lane)
    λ_o, λ_d, L = backward_sweep(records, δL, flow_of(job), job.motion)
    if job.facts.view_moves:
        λ_d = λ_d + _skipped(job, p, records) * λ_o
        # Stored: each entry of the pose is a sum over all samples, in a kernel that would walk back anew.
        dr.eval(λ_o, λ_d, *([] if job.film_flow is None else [L]))
        with dr.resume_grad():
            # other terms need the sensor's edges
            accumulate(film_places.camera_adjoint(job, p.ray, p.p, p.per_px, (λ_o, λ_d)))
    if job.film_flow is not None:
        L = job.call.counters.rejected.keep_finite(L)
        film_places.backward(job, partial(film_places.of_samples, job, p, records, L), share * grad_in)
    dr.eval()


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Whatever depends on θ changes paths or what they carry."""
    if facts.places_move:
        return True, f"places on the film follow what is seen, and {what_changes(facts)} change"
    if options.depth_limit == 1:
        radiance = any(e.radiance or e.pose for e in facts.emitters)
        emitting = any(s.is_emitter and s.shading for s in facts.shapes)
        slides = facts.geometry_moves and any(e.varies for e in facts.emitters)
        if not (radiance or emitting or slides):
            return False, "max_depth = 1: only emission is seen, and it is the same at every point"
    return True, f"{what_changes(facts)} change along every path"


TERM = Term(
    name="interior",
    budget="sppc",
    streams=(Stream.CAMERA, Stream.INTERIOR, Stream.LIGHT_SUBPATH, Stream.SPHERE_RIMS, Stream.SPHERE_RIM_PATHS,
             Stream.FILM_BORDER),
    needed=needed,
    cost=lambda form, sky: 1.25 if form == "mixed" else 1.0,  # vertices are looked at once more
    with_light=4.2,  # 1.4 times as much as with two light subpaths per sample, which made it 2.5 to 5.6
    forward=forward,
    backward=backward,
    over_film=True,
)
