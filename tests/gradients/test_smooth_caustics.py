"""`psdr_bdpt`: caustics of mirrors and smooth glass.

Of area lights they are what `path` shows, with less noise. Of points they are in no image of `path`: a plane mirror
shows a point light a second time, which is an exact reference; for glass, finite differences of the image itself are.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, forward, functionals, images, z_scores
from variants import also

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import UnsupportedError

X, Y = (1, 0, 0), (0, 1, 0)
LIMITS = {"max_depth": 5, "rr_depth": 1000}
INTERIOR = {"form": "spatial", "sppp": 0, "spps": 0, "sppd": 0, "sppi": 0}
SEEDS = 8
SLOW = pytest.mark.slow
TOLERANCE = 1e-5  # of the adjoint identity

#: Away from the film's border, where `path` filters what is inside of the film alone, and light subpaths all.
INSIDE = (slice(None), slice(2, -2), slice(2, -2))

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


def bdpt(**options) -> dict:
    return {"type": "psdr_bdpt", **LIMITS, **options}


def film(rfilter: str = "gaussian") -> dict:
    return {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": rfilter}, "pixel_format": "luminance"}


def floor() -> dict:
    pose = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "diffuse"}}


def spot(origin, target, cutoff: float = 15) -> dict:
    pose = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0, 1])
    return {"type": "spot", "intensity": 10.0, "cutoff_angle": cutoff, "beam_width": cutoff / 2, "to_world": pose}


def mirrored(mirror: bool) -> mi.Scene:
    """A spotlight that a mirror at x = −1 throws onto the floor, or what it looks like from there without a mirror."""
    pose = mi.ScalarTransform4f
    camera = {"type": "perspective", "fov": 40, "film": film(),
              "to_world": pose().look_at(origin=[0.3, 1.5, 1.8], target=[0.1, -1, 0], up=[0, 1, 0])}  # fmt: skip
    scene = {"type": "scene", "camera": camera, "floor": floor()}
    if not mirror:
        return mi.load_dict({**scene, "lamp": spot([-1.8, 0.9, 0], [-1, 0.1, 0])}, optimize=False)
    sheet = {"type": "rectangle", "to_world": pose().translate([-1, 0.1, 0]).rotate([0, 1, 0], 90),
             "bsdf": {"type": "conductor", "material": "none"}}  # fmt: skip
    return mi.load_dict({**scene, "mirror": sheet, "lamp": spot([-0.2, 0.9, 0], [-1, 0.1, 0])}, optimize=False)


def glass_ball(light: str = "spot", sensor: str = "perspective", rfilter: str = "gaussian") -> mi.Scene:
    """The caustic of a ball of smooth glass on a floor; the ball is out of view and hides nothing."""
    pose = mi.ScalarTransform4f().look_at(origin=[-1.6, 0.6, 1.6], target=[-0.5, -1, 0.4], up=[0, 1, 0])
    kinds = {"perspective": {"fov": 20}, "orthographic": {},
             "thinlens": {"fov": 20, "aperture_radius": 0.1, "focus_distance": 2.0}}  # fmt: skip
    if sensor == "orthographic":
        pose = pose @ mi.ScalarTransform4f().scale([0.4, 0.4, 1])
    above = [0.8, 2.2, -0.6]
    down = mi.ScalarTransform4f().look_at(origin=above, target=[0, -0.15, 0], up=[1, 0, 0])
    lights = {"spot": spot(above, [0, -0.15, 0], 20), "point": {"type": "point", "intensity": 10.0, "position": above},
              "bulb": {"type": "sphere", "center": above, "radius": 0.3, "emitter": {"type": "area", "radiance": 20.0}},
              "panel": {"type": "rectangle", "to_world": down @ mi.ScalarTransform4f().scale(1.2),
                        "emitter": {"type": "area", "radiance": 20.0}},
              "card": {"type": "rectangle", "to_world": down @ mi.ScalarTransform4f().scale(0.3),
                       "emitter": {"type": "area", "radiance": 20.0}}}  # fmt: skip
    return mi.load_dict({
        "type": "scene", "lamp": lights[light], "floor": floor(),
        "camera": {"type": sensor, "to_world": pose, "film": film(rfilter), **kinds[sensor]},
        "ball": {"type": "sphere", "center": [0, -0.15, 0], "radius": 0.5, "bsdf": {"type": "psdr_dielectric"}},
    }, optimize=False)  # fmt: skip


def differences(motion, spec: dict, eps: float, spp: int) -> np.ndarray:
    """Of the image that `spec` itself makes, (SEEDS, H, W, C)."""
    difference = CentralDifference(motion, spec, 0, spp, eps, groups=SEEDS // 2)
    difference.add(SEEDS // 2)
    return np.concatenate([half.group_means() for half in difference.halves])


@pytest.mark.parametrize("light_paths", ["auto", also("only")])
@pytest.mark.parametrize("light", ["card", pytest.param("bulb", marks=SLOW)])
def test_image_of_an_area_light(llvm, light, light_paths):
    """Weights of both ways add up to one, whatever is found by whom."""
    scene = glass_ball(light)
    path = images(scene, {"type": "path", **LIMITS}, 512, 4 * SEEDS, 1000)
    ours = images(scene, bdpt(light_paths=light_paths), 128, 4 * SEEDS)
    weights = functionals(ours.shape[1:])
    assert np.abs(z_scores(ours, path, weights)).max() < 5
    assert np.abs(z_scores(0.9 * ours, path, np.ones_like(weights[:1]))).max() > 5, "no power to tell a tenth"


def test_image_of_a_point(variant):
    """In a mirror: as of a second light behind it."""
    exact = images(mirrored(False), {"type": "path", "max_depth": 2}, 256, 4 * SEEDS, 1000)[INSIDE]
    ours = images(mirrored(True), bdpt(), 64, 4 * SEEDS)[INSIDE]
    assert np.abs(z_scores(ours, exact, functionals(ours.shape[1:]))).max() < 5
    assert abs(ours.mean() / exact.mean() - 1) < 0.01 and exact.mean() > 0.01


@pytest.mark.parametrize("moved, factor", [
    (("lamp.to_world", X), -1), pytest.param(("lamp.to_world", Y), 1, marks=SLOW),
    pytest.param(("mirror.to_world", X), 2, marks=SLOW), pytest.param(("camera.to_world", X), None, marks=SLOW),
    pytest.param(("floor.to_world", Y), None, marks=SLOW),
], ids=lambda value: value[0] if isinstance(value, tuple) else "")  # fmt: skip
def test_a_plane_mirror(llvm, moved, factor):
    """What moves the light or the mirror moves the light behind it; no finite differences."""
    name, direction = moved
    other = name if factor is None else "lamp.to_world"
    exact = forward(perturb(mirrored(False), other, direction), {"type": "psdr_path", "max_depth": 2}, SEEDS, 512)
    ours = forward(perturb(mirrored(True), name, direction), bdpt(**INTERIOR), SEEDS, 256)[INSIDE]
    assert_grad_close(ours, (factor or 1) * exact[INSIDE])


CASES = [
    ("lamp.to_world", dict(direction=X), {}),
    ("ball.bsdf.eta", {}, {}),
    ("ball.to_world", dict(direction=X), {}),
    ("floor.to_world", dict(direction=Y), {}),
    ("camera.to_world", dict(direction=X), {}),
    ("lamp.position", dict(direction=X), dict(light="point")),
    ("lamp.to_world", dict(direction=X), dict(sensor="orthographic")),
    ("camera.to_world", dict(direction=X), dict(sensor="thinlens")),
    ("camera.x_fov", {}, {}),
    ("camera.x_fov", {}, dict(sensor="thinlens")),
]


@pytest.mark.slow
@pytest.mark.parametrize("param, how, scene", CASES, ids=lambda value: "")
def test_glass(llvm, param, how, scene):
    motion = perturb(glass_ball(**scene), param, **how)
    estimate = forward(motion, bdpt(form="spatial"), SEEDS, 256)
    assert_grad_close(estimate, differences(motion, bdpt(), 0.001, 1024), max_stderr=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("param", ["floor.to_world", "ball.bsdf.eta"])
def test_same_flow_however_found(llvm, param):
    """Of an area light, the interior term alone: what the light finds against what the camera finds."""
    motion = perturb(glass_ball("panel"), param, **({} if param.endswith("eta") else dict(direction=Y)))
    by_camera, by_light = (
        forward(motion, bdpt(**INTERIOR, sppc=1, light_paths=how), SEEDS, spp)
        for how, spp in (("off", 1024), ("only", 1024))
    )
    assert_grad_close(by_light, by_camera, max_stderr=0.06)


@pytest.mark.parametrize("light, param", [
    ("spot", "ball.bsdf.eta"),
    pytest.param("spot", "lamp.to_world", marks=SLOW), pytest.param("card", "ball.to_world", marks=SLOW),
    pytest.param("spot", "camera.to_world", marks=SLOW), pytest.param("point", "ball.to_world", marks=SLOW),
    pytest.param("spot", "camera.x_fov", marks=SLOW),
])  # fmt: skip
def test_forward_and_backward_are_transposes(variant, light, param):
    integrator = integrator_specs.build(bdpt(**INTERIOR, sppc=8))
    wJv, JTwv, w, Jv = adjoint_identity(glass_ball(light), param, integrator)
    assert Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"


def test_a_box_filter_is_refused(llvm):
    motion = perturb(glass_ball(rfilter="box"), "lamp.to_world", X)
    motion.attach()
    integrator = integrator_specs.build(bdpt(**INTERIOR, sppc=4))
    with pytest.raises(UnsupportedError, match="box filter"):
        integrator.render_forward(motion.scene, motion.params, spp=4)
