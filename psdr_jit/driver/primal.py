"""The image itself: which plugin of Mitsuba renders it; and where light subpaths help, camera paths with their share of
the weights, and what light brings.

That is equal in expectation to Mitsuba's `path`, but for light of points by way of mirrors and smooth glass, which
camera paths cannot find.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.low_discrepancy import lane_sampler
from ..core.memory import Memory
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..interior.camera_pass import CameraPass, camera_passes
from ..options import samples_per_pixel
from ..paths.bounce import PathLimits
from ..paths.light_walk import trace_light
from ..paths.walk import NoSink, first_hit, walk
from ..plan.call import Call
from ..plan.job import Job
from ..plan.light_plan import plan_light
from ..plan.motion import SceneMotion
from ..plan.plan import Plan
from ..scene.facts import analyse


def image_plugin(scene: mi.Scene, hide_emitters: bool) -> str:
    """The plugin of Mitsuba that renders the image of `scene` in full: `path`, or `prb`.

    Of a path that leaves the scene, `path` drops all light if the lobes that it followed were null ones and no sky is
    there to be seen: what masks reflect is darker by their opacity [Mitsuba 3.9.1, `src/integrators/path.cpp`,
    `valid_ray`].
    """
    if scene.environment() is not None and not hide_emitters:
        return "path"
    bsdfs = (shape.bsdf() for shape in scene.shapes())
    passes = any(bsdf is not None and bsdf.flags() & int(mi.BSDFFlags.Null) for bsdf in bsdfs)
    return "prb" if passes else "path"


def bidirectional_image(call: Call) -> mi.TensorXf | None:
    """The image, detached; None where light subpaths are not traced, and the image is that of `path`."""
    if call.options.light_paths == "off":
        return None
    facts = analyse(call.scene, call.sensor, memory=call.memory)
    light = plan_light(call.scene, facts, call.options, call.memory)
    if not light.runs:
        return None
    films.require_film(call.sensor.film())
    spp = samples_per_pixel(None, call.spp, call.sensor.sampler().sample_count())
    plan = Plan("spatial", "", "", (), False, light)
    image = 0
    with dr.suspend_grad():
        job = Job(call, facts, plan, SceneMotion(call.sensor), Memory(), spp)
        limits = replace(job.limits, light=job.light)
        for p in camera_passes(job):
            image += p.share * (_from_camera(job, p, limits) + _from_light(job, p, limits))
    return image


def _from_camera(job: Job, p: CameraPass, limits: PathLimits) -> mi.TensorXf:
    """What camera paths find, at their share of the weights."""
    ray, pi, emission = first_hit(job.scene, mi.Ray3f(dr.detach(p.ray)), job.options.hide_emitters)
    sampler = p.sampler(dr.arange(mi.UInt32, p.samples.count))
    L, _, surface = walk(job.scene, sampler, ray, pi, limits, NoSink(), emission, mi.Bool(True))
    if job.sky_is_seen:
        surface = mi.Bool(True)
    alpha = dr.select(surface, mi.Float(1), 0)
    L = job.call.counters.rejected.keep_finite(L)
    return films.develop_samples(job.film, p.at, L * p.weight, p.ray.wavelengths, alpha)


def _from_light(job: Job, p: CameraPass, limits: PathLimits) -> mi.TensorXf:
    """What light subpaths bring, as many as there are camera samples."""
    lanes = job.plan.light.subpaths(job.frame, p.samples.spp)
    rng = lane_sampler(stream_seed(p.seed, Stream.LIGHT_SUBPATH), dr.arange(mi.UInt32, lanes))
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    start = limits.light.sources.sample(rng, wavelengths)
    path = trace_light(job.scene, rng, start, limits, job.options.hide_emitters)
    value = job.call.counters.rejected.keep_finite(path.value * weight / varying(mi.Float, lanes))
    found = path.count > 0
    if not limits.light.delta_lobes:
        return films.develop_boundary(job.film, path.p, value, mi.Float(0), wavelengths, found)
    shared = films.develop_boundary(job.film, path.p, value, mi.Float(0), wavelengths, found & ~path.alone)
    return shared + films.develop_splats(job.film, path.p, value, wavelengths, found & path.alone)
