"""Only relative motion counts: what moves together, the camera included, has no derivative at all."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import load, spec_of
from problems import Problem

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

SEEDS, SPP, SIZE, BLOCK = 16, 64, 16, 4
BOUND = 5.0  # standard errors

CASES = {
    "mesh-shadow": ("area_shadow", ("blocker.vertex_positions", "floor.to_world", "light.to_world", "camera.to_world")),
    "ball-shadow": ("ball_shadow", ("blocker.to_world", "floor.to_world", "light.to_world", "camera.to_world")),
    "lamp": ("point_shadow", ("blocker.vertex_positions", "floor.to_world", "lamp.position", "camera.to_world")),
    "sunk": ("sunk_box", ("box.vertex_positions", "floor.to_world", "light.to_world", "camera.to_world")),
    "sunk-ball": ("sunk_ball", ("ball.to_world", "floor.to_world", "light.to_world", "camera.to_world")),
    "sky": ("constant_shadow", ("blocker.vertex_positions", "floor.to_world", "camera.to_world")),
}


def derivative(case: str, moving: int, direction) -> np.ndarray:
    """Images (seeds, H, W, C) for a common motion of the first `moving` parameters of a case.

    The others have gradients enabled and rest, so that the kernels are the same ones.
    """
    scene_name, names = CASES[case]
    scene = load(Problem(scene_name, names[0], 0.0), res=SIZE, max_depth=3)
    motions = [perturb(scene, name, direction) for name in names]
    integrator = integrator_specs.build(spec_of(scene))
    images = []
    for seed in range(SEEDS):
        θ, rest = mi.Float(0), mi.Float(0)
        dr.enable_grad(θ, rest)
        for k, motion in enumerate(motions):
            motion.params[motion.name] = motion.curve(θ if k < moving else rest)
            motion.params.set_dirty(motion.name)
            motion.params.update()
        dr.set_grad(θ, 1)
        dr.enqueue(dr.ADMode.Forward, θ, rest)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        images.append(np.array(integrator.render_forward(scene, None, seed=seed, spp=SPP), dtype=np.float64))
    return np.stack(images)


def blocks(images: np.ndarray) -> np.ndarray:
    n, h, w, c = images.shape
    return images.reshape(n, h // BLOCK, BLOCK, w // BLOCK, BLOCK, c).mean((2, 4))


SLOW = ("lamp", "sunk-ball", "sunk", "ball-shadow", "mesh-shadow", "sky")  # many kernels to compile


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in CASES])
def test_nothing_changes(llvm, case):
    direction = (0.6, 0.3, -0.5)
    together = blocks(derivative(case, len(CASES[case][1]), direction))
    alone = blocks(derivative(case, 1, direction))
    error = together.std(0, ddof=1) / np.sqrt(SEEDS)
    signal = np.abs(alone.mean(0)).max()
    assert np.all(np.abs(together.mean(0)) <= BOUND * error + 1e-3 * signal)
    assert np.sqrt(np.mean(error**2)) < 0.05 * signal  # the bound can fail: one of them alone is far from zero
