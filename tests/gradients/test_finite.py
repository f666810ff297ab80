"""No derivative image or gradient holds a value that is not finite, and no sample had to be dropped to get there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import load, motion_of, spec_of
from problems import PROBLEMS, Problem

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

SIZE, SPP = 16, 4
QUICK = ("area_shadow", "sunk_ball")


def check(problem: Problem, seeds: int) -> None:
    scene = load(problem, **({} if problem.scene == "camera_crop" else {"res": SIZE}))  # its window has a fixed size
    motion = motion_of(problem, scene)
    integrator = integrator_specs.build(spec_of(scene, **problem.options))
    film = scene.sensors()[0].film()
    channels = 4 if "rgba" in problem.load.values() else 3
    grad_in = dr.ones(mi.TensorXf, (*reversed(film.crop_size()), channels))
    for seed in range(seeds):
        motion.attach()
        image = np.array(integrator.render_forward(scene, motion.params, seed=seed, spp=SPP))
        assert np.isfinite(image).all()
        θ = mi.Float(0)
        dr.enable_grad(θ)
        motion.params[motion.name] = motion.curve(θ)
        motion.params.set_dirty(motion.name)
        motion.params.update()
        integrator.render_backward(scene, motion.params, grad_in, seed=seed, spp=SPP)
        assert np.isfinite(float(dr.grad(θ)[0]))
    motion.restore()
    assert integrator_specs.rejected(integrator) == 0


def once(problems) -> list[Problem]:
    """The first problem of each scene and parameter."""
    return list({(p.scene, p.param, str(p.load)): p for p in reversed(problems)}.values())


@pytest.mark.slow
@pytest.mark.parametrize("problem", [pytest.param(p, id=p.id) for p in once(PROBLEMS) if p.scene in QUICK])
def test_quick(llvm, problem):
    check(problem, 2)


@pytest.mark.slow
@pytest.mark.parametrize("problem", [pytest.param(p, id=p.id) for p in once(PROBLEMS)])
def test_all_scenes(llvm, problem):
    check(problem, 20)


@pytest.mark.parametrize("form", ["spatial", pytest.param("material", marks=pytest.mark.slow)])
def test_a_glowing_sphere_that_samples_itself(llvm, form):
    """Mitsuba draws points of the sphere from its own surface, and now and then the very point that it starts from."""
    pose = mi.ScalarTransform4f().look_at(origin=[3.75, 0, 15], target=[3.75, 0, 0], up=[0, 1, 0])
    camera = {"type": "perspective", "to_world": pose, "fov": 8, "film": {"type": "hdrfilm", "width": 16, "height": 16}}
    lamp = {"type": "sphere", "center": [3.75, 0, 0], "radius": 0.9, "emitter": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict({"type": "scene", "camera": camera, "lamp": lamp})
    motion = perturb(scene, "camera.to_world", direction=(0.6, 0.3, -0.5))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "form": form})
    motion.attach()
    integrator.render_forward(scene, motion.params, seed=0, spp=256)
    assert integrator_specs.rejected(integrator) == 0
