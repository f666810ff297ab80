"""Samples on the rims of spheres: they take over exactly what the film's own samples leave, and bound the variance."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.interior import camera_pass, sphere_rims
from psdr_jit.interior import term as interior
from psdr_jit.interior.sphere_rims import SphereRims
from psdr_jit.plan.job import Job
from psdr_jit.scene import io as scene_io

WIDTH, HEIGHT, SPP = 24, 20, 8192

CAMERAS = {
    "pinhole": {"type": "perspective"},
    "lens": {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 4.0},
    "cut": {"type": "perspective", "near_clip": 3.2},  # the near plane runs through two balls
}

FILMS = {
    "whole": {},
    "crop": {"crop_offset_x": 4, "crop_offset_y": 6, "crop_width": 13, "crop_height": 9},
    "border": {"rfilter": {"type": "gaussian"}, "sample_border": True},
}


def balls(camera: dict, film: dict) -> mi.Scene:
    """A ball half outside of the picture, one partly before another, and one behind the camera."""

    def ball(x: float, z: float, radius: float) -> dict:
        return {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([x, 0.1, z]).scale(radius)}

    return mi.load_dict({
        "type": "scene",
        "sensor": {
            "near_clip": 0.1, "fov": 40, "to_world": mi.ScalarTransform4f().look_at([0, 0.3, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}, **film},
            **camera,
        },
        "outside": ball(-1.7, 0.0, 0.6), "before": ball(0.3, 1.0, 0.3), "after": ball(0.5, 0.0, 0.6),
        "behind": ball(0.0, 8.0, 0.5), "light": {"type": "constant"},
    })  # fmt: skip


def job_of(scene: mi.Scene, param: str, spp: int) -> Job:
    motion = perturb(scene, param, direction=[1, 0, 0] if param.endswith("to_world") else None)
    motion.attach()
    alone = {"sppc": spp, "sppp": 0, "sppd": 0, "sppi": 0, "spps": 0}
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": "spatial", **alone})
    (_, job), *_ = prepare(integrator.call(scene, scene.sensors()[0], 1, spp)).jobs
    return job


@pytest.mark.parametrize("film", FILMS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_both_kinds_of_samples_add_up(camera, film, llvm):
    """Of the film's area, rims take what they are left, whatever hides them and wherever the film ends."""
    job = job_of(balls(CAMERAS[camera], FILMS[film]), "sensor.to_world", SPP)
    with dr.suspend_grad():
        given = taken = error2 = 0.0
        for p in camera_pass.camera_passes(job):
            rims = SphereRims.of(job)
            left = np.array(rims.left_to_film(p.samples, mi.Ray3f(dr.detach(p.ray))))
            given += p.share * (1 - left).sum() / p.samples.spp
            weight = p.share * np.array(rims.sample(p.samples, p.seed).weight).mean(0)
            taken, error2 = taken + weight.sum(), error2 + np.square(weight).sum()
    assert given > 1 and error2 < (0.01 * given) ** 2  # [px]
    assert abs(taken - given) < 3 * np.sqrt(error2)


def test_a_ball_around_the_camera_has_no_rim(llvm):
    """Rays that leave it may be all but tangent to it."""
    scene = balls(CAMERAS["pinhole"], FILMS["whole"])
    params = mi.traverse(scene)
    params["before.to_world"] = mi.Transform4f().translate([4.1, 0.3, 4.0]).scale(4.2)
    params.update()
    job = job_of(scene, "before.to_world", 4)
    with dr.suspend_grad():
        (p,) = camera_pass.camera_passes(job)
        assert dr.all(SphereRims.of(job).left_to_film(p.samples, mi.Ray3f(dr.detach(p.ray))) == 1)
        assert SphereRims.of(job).sample(p.samples, p.seed) is None


def test_only_what_slides_has_rims(llvm):
    """A ball at rest before a camera at rest, and what is not a sphere, need none."""
    scenes = [balls(CAMERAS["pinhole"], FILMS["whole"]) for _ in range(2)]
    assert SphereRims.of(job_of(scenes[0], "before.to_world", 1)).count == 1
    assert SphereRims.of(job_of(scenes[1], "before.bsdf.reflectance.value", 1)) is None


@pytest.mark.slow
def test_the_variance_no_longer_comes_from_the_outline(llvm, monkeypatch):
    """A ball of glass moves before a picture: the same image, of which pixels at the outline were far noisier."""
    scene = scene_io.load_scene(scene_io.shipped_scene("glass.xml"), res=16)
    job = job_of(scene, "body.to_world", 32)

    def images(count: int) -> np.ndarray:
        seeds = (replace(job, call=replace(job.call, seed=seed)) for seed in range(count))
        return np.stack([np.array(interior.forward(seeded)).mean(-1) for seeded in seeds])

    with_rims = images(24)
    monkeypatch.setattr(sphere_rims.SphereRims, "of", staticmethod(lambda job: None))
    without = images(48)
    few, many = with_rims.var(0, ddof=1), without.var(0, ddof=1)
    assert many.mean() > 3 * few.mean()
    error = np.sqrt(few / len(with_rims) + many / len(without))
    z = (with_rims.mean(0) - without.mean(0))[error > 0] / error[error > 0]
    assert np.abs(z).max() < 5 and np.sqrt(np.mean(z**2)) < 1.25
