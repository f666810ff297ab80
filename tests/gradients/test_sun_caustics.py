"""`psdr_bdpt`: caustics of directional lights, which are those of a point that is far away.

What a plane mirror sends to a floor has a closed form, the irradiance of the light from its mirrored direction. For
glass, the reference is a point light far away, whose light differs by some thousandths at most.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, forward, functionals, images, z_scores
from test_smooth_caustics import INTERIOR, LIMITS, SEEDS, TOLERANCE, X, bdpt, film, floor

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

FAR, NEARER = 3000.0, 1000.0  # of images; of derivatives, for which directions in float32 must be told apart
TO = np.array([-0.31, -0.91, 0.23]) / np.linalg.norm([-0.31, -0.91, 0.23])  # of the light
SLOW = pytest.mark.slow

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


def sun(direction, irradiance: float = 2.0) -> dict:
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=list(direction), up=[1, 0, 0])
    return {"type": "directional", "to_world": pose, "irradiance": irradiance}


def far_point(middle, r: float) -> dict:
    return {"type": "point", "position": list(np.array(middle) - r * TO), "intensity": 2.0 * r**2}


def mirror(normal_irradiance: float = 2.0) -> mi.Scene:
    """A mirror at x = −1 that sends the light of the sun down onto the floor."""
    T = mi.ScalarTransform4f
    sheet = {"type": "rectangle", "to_world": T().translate([-1, 0.1, 0]).rotate([0, 1, 0], 90).scale(0.5),
             "bsdf": {"type": "conductor", "material": "none"}}  # fmt: skip
    view = T().look_at(origin=[0.3, 1.5, 1.8], target=[0.1, -1, 0], up=[0, 1, 0])
    camera = {"type": "perspective", "fov": 40, "film": film(), "to_world": view}
    lamp = sun([-0.8, -0.8, 0.1], normal_irradiance)
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor(), "mirror": sheet, "lamp": lamp},
                        optimize=False)  # fmt: skip


def glass(far: bool, body: str = "ball", card: bool = False, r: float = FAR) -> mi.Scene:
    """The caustic of a body of smooth glass, and a card in the way of the light; which is `far`, or a point at `r`."""
    T = mi.ScalarTransform4f
    view = T().look_at(origin=[-1.6, 1.0, 1.6], target=[-0.35, -1, 0.35], up=[0, 1, 0])
    turned = T().translate([0, -0.35, 0]).rotate([0.436, 0.873, 0.218], 40).scale(0.3)
    ball, smooth = {"type": "sphere", "center": [0, -0.15, 0], "radius": 0.5}, {"type": "psdr_dielectric"}
    bodies = {"ball": {**ball, "bsdf": smooth}, "cube": {"type": "cube", "to_world": turned, "bsdf": smooth},
              "rough ball": {**ball, "bsdf": {"type": "roughdielectric", "alpha": 0.15}}}  # fmt: skip
    scene = {"type": "scene", "lamp": sun(TO) if far else far_point([0, -0.15, 0], r), "floor": floor(),
             "camera": {"type": "perspective", "to_world": view, "film": film(), "fov": 40},
             "body": bodies[body]}  # fmt: skip
    if card:
        at = np.array([0, -0.15, 0]) - 1.3 * TO + [0.05, 0, 0]
        pose = T().look_at(origin=list(at), target=list(at + TO), up=[1, 0, 0]) @ T().scale(0.1)
        black = {"type": "twosided", "sheet": {"type": "diffuse", "reflectance": 0.0}}
        scene["card"] = {"type": "rectangle", "to_world": pose, "bsdf": black}
    return mi.load_dict(scene, optimize=False)


def patch(scene: mi.Scene, spp: int) -> np.ndarray:
    """What the mirror adds, well inside of the patch that it lights."""
    ours, path = images(scene, bdpt(), spp, SEEDS), images(scene, {"type": "path", **LIMITS}, spp, SEEDS)
    return (ours.mean(0) - path.mean(0))[8:10, 6:9]


def test_a_mirror_in_the_sun(variant):
    """E cosθ ρ/π, whatever the samples."""
    down = 0.8 / np.linalg.norm([0.8, 0.8, 0.1])
    assert np.allclose(patch(mirror(), 64), 2.0 * down * 0.5 / np.pi, rtol=2e-3)


@pytest.mark.slow
def test_a_mirror_in_a_turning_sun(llvm):
    """Inside of the patch, and of what the sun lights: the derivative of a cosine, E ρ/π |ḋ_y|."""
    found = forward(perturb(mirror(), "lamp.to_world", rotate=[0, 0, 1]), bdpt(**INTERIOR), 2, 256).mean(0)
    d = np.array([-0.8, -0.8, 0.1]) / np.linalg.norm([0.8, 0.8, 0.1])
    rate = -np.cross([0, 0, 1], d)[1] * 2.0 * 0.5 / np.pi
    assert np.allclose(found[0], rate, rtol=1e-3)
    assert np.allclose(found[8:10, 6:9], 2 * rate, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("body", ["ball", "cube"])
def test_image_of_glass(llvm, body):
    near, far = (images(glass(far, body), bdpt(), 256, SEEDS) for far in (False, True))
    weights = functionals(far.shape[1:])
    assert np.abs(z_scores(far, near, weights)).max() < 5
    assert np.abs(z_scores(0.97 * far, near, np.ones_like(weights[:1]))).max() > 5, "no power to tell 3 %"


@pytest.mark.slow
@pytest.mark.parametrize("light_paths", ["auto", "only"])
def test_image_of_rough_glass(llvm, light_paths):
    """Where camera paths find the light as well: weights of both ways add up to one."""
    scene = glass(True, "rough ball")
    path = images(scene, {"type": "path", **LIMITS}, 2048, SEEDS, 1000)
    ours = images(scene, bdpt(light_paths=light_paths), 256, SEEDS)
    weights = functionals(ours.shape[1:])
    assert np.abs(z_scores(ours, path, weights)).max() < 5
    assert np.abs(z_scores(0.95 * ours, path, np.ones_like(weights[:1]))).max() > 5, "no power to tell 5 %"


CASES = [
    ("lamp", {}, dict(card=True), 64), ("card.to_world", dict(direction=X), dict(card=True), 512),
    ("body.bsdf.eta", {}, {}, 64), ("body.to_world", dict(direction=X), {}, 64),
    ("camera.to_world", dict(direction=X), {}, 64),
    ("body.vertex_positions", dict(direction=X), dict(body="cube"), 128),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("param, how, scene, spp", CASES, ids=lambda value: value if isinstance(value, str) else "")
def test_derivatives_by_what_is_far(llvm, param, how, scene, spp):
    exact, ours = (forward(_motion(glass(far, r=NEARER, **scene), param, far, how), bdpt(form="spatial"), SEEDS, spp)
                   for far in (False, True))  # fmt: skip
    assert_grad_close(ours, exact, max_stderr=0.05)


def _motion(scene: mi.Scene, param: str, far: bool, how: dict):
    """A light is turned about the x axis; that moves a far one."""
    if param != "lamp":
        return perturb(scene, param, **how)
    if far:
        return perturb(scene, "lamp.to_world", rotate=[1, 0, 0])
    return perturb(scene, "lamp.position", direction=list(np.cross([1, 0, 0], -NEARER * TO)))


@pytest.mark.slow
@pytest.mark.parametrize("param", ["lamp.to_world", "body.to_world", "body.bsdf.eta", "lamp.irradiance.value"])
def test_forward_and_backward_are_transposes(llvm, param):
    integrator = integrator_specs.build(bdpt(form="spatial", sppc=8, spps=8, sppd=8, sppi=8, sppp=8))
    wJv, JTwv, w, Jv = adjoint_identity(glass(True, card=True), param, integrator)
    assert Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"
