"""The `batch` sensor: its derivative is that of its sensors side by side, in both modes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from batch_views import ORIGINS, RES, VIEWS, batch_of

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb


def film(width: int) -> dict:
    return {"type": "hdrfilm", "width": width, "height": RES, "pixel_format": "rgb", "rfilter": {"type": "gaussian"}}


def psdr(**options) -> mi.Integrator:
    return integrator_specs.build({"type": "psdr_path", "max_depth": 2, "sppc": 16, "sppp": 16, "sppi": 16, **options})


@pytest.fixture
def moved(llvm):
    motion = perturb(batch_of(), "blocker.vertex_positions", (1, 0, 0.3))
    yield motion
    motion.restore()


def test_sensors_stand_side_by_side(moved):
    motion = moved
    batch = motion.scene.sensors()[0]
    image = np.array(psdr().render(motion.scene, batch, seed=3, spp=16))
    assert image.shape == (RES, RES * VIEWS, 3)
    own = np.array(mi.load_dict({"type": "path", "max_depth": 2}).render(motion.scene, batch, seed=1, spp=256))
    inner = [x for x in range(RES * VIEWS) if 2 <= x % RES < RES - 2]  # Mitsuba's own bleeds over the seams
    assert np.abs(image - own)[:, inner].mean() < 0.1 * own.mean()
    assert np.abs(image[:, :RES] - image[:, RES : 2 * RES]).mean() > 0.1 * own.mean()


def test_forward_and_backward_mode_agree(moved):
    motion = moved
    weights = np.random.default_rng(0).normal(size=(RES, RES * VIEWS, 3)).astype(np.float32)
    motion.attach()
    image = np.array(psdr().render_forward(motion.scene, motion.params, seed=5))
    assert image.shape == weights.shape and all(np.abs(part).max() > 0.05 for part in np.split(image, VIEWS, axis=1))
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.params[motion.name] = motion.curve(θ)
    motion.params.update()
    psdr().render_backward(motion.scene, motion.params, mi.TensorXf(weights), seed=5)
    expected = float((image.astype(float) * weights).sum())
    assert float(dr.grad(θ)[0]) == pytest.approx(expected, rel=1e-4)


def test_budgets_are_those_that_were_set(moved):
    motion = moved
    integrator = psdr(sppc=7, sppp=9, sppi=11)
    motion.attach()
    integrator.render_forward(motion.scene, motion.params, seed=5)
    spp = {term.name: term.spp for term in integrator.plan.terms if term.runs}
    assert spp == {"interior": 7, "primary": 9, "direct": 11}


def test_derivative_is_that_of_each_sensor(moved):
    motion = moved
    motion.attach()
    batch = np.array(psdr().render_forward(motion.scene, motion.params, seed=5))
    for k, origin in enumerate(ORIGINS):
        view = mi.load_dict({"type": "perspective", "fov": 40, "film": film(RES), "to_world":
                             mi.ScalarTransform4f().look_at(origin, [0, -0.5, 0], [0, 1, 0])})  # fmt: skip
        motion.attach()
        options = {"sppc": 256, "sppp": 256, "sppi": 256}
        alone = np.array(psdr(**options).render_forward(motion.scene, motion.params, sensor=view, seed=9))
        part = batch[:, k * RES : (k + 1) * RES]
        slope = (part * alone).sum() / (alone * alone).sum()
        assert slope == pytest.approx(1, abs=0.1)  # 0, -1 and 1/2 are not


def test_the_film_of_the_batch_counts(moved):
    """Sensors without a film of their own get Mitsuba's default, which filters otherwise."""
    motion, look = moved, mi.ScalarTransform4f().look_at

    def views(**own) -> dict:
        pose = {"fov": 40, "to_world": look(ORIGINS[0], [0, -0.5, 0], [0, 1, 0])}
        return {f"view{k}": {"type": "perspective", **pose, **own} for k in range(2)}

    box = {"type": "hdrfilm", "width": 2 * RES, "height": RES, "pixel_format": "luminance", "rfilter": {"type": "box"}}
    found = []
    for own in ({}, {"film": {**box, "width": RES}}):
        batch = mi.load_dict({"type": "batch", "film": box, **views(**own)})
        motion.attach()
        found.append(np.array(psdr().render_forward(motion.scene, motion.params, sensor=batch, seed=5)))
        image = mi.render(motion.scene, sensor=batch, integrator=psdr(), spp=4)
        assert image.shape == found[-1].shape == (RES, 2 * RES, 1)
    assert np.abs(found[0]).max() > 0.05
    np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-4)


def test_a_camera_of_the_batch_can_move(llvm):
    scene = batch_of()
    name = next(n for n in mi.traverse(scene).keys() if n.endswith("view1.to_world"))
    motion = perturb(scene, name, (1, 0, 0))
    motion.attach()
    image = np.array(psdr().render_forward(scene, motion.params, seed=1))
    motion.restore()
    others = np.abs(np.concatenate([image[:, :RES], image[:, 2 * RES :]], axis=1)).max()
    assert others == 0 and np.abs(image[:, RES : 2 * RES]).max() > 0.05
