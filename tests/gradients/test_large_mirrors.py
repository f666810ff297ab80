"""`psdr_bdpt`: light of points that a mirror as large as the scene, or plastic, throws back onto a wall.

Mitsuba's `ptracer` shows all of it where the sensor sees what is diffuse. Moved, finite differences of the image tell.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, functionals, images, z_scores
from variants import also

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene.io import shipped_scene

LIMITS = {"max_depth": 4, "rr_depth": 1000}
BDPT = {"type": "psdr_bdpt", **LIMITS}
SEEDS = 12
BORDER = 3  # [px] where `ptracer` misses what samples outside of the film bring
STEP = 0.003  # of differences: the shadow of the roof's edge is narrow
TOLERANCE = 1e-5  # of the adjoint identity
BUDGETS = ("sppc", "sppp", "spps", "sppd", "sppi")
X = (1, 0.3, 0.2)

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


def room(floor: dict, light: str) -> mi.Scene:
    """A wall with a small roof, above a shining floor that is out of view."""
    pose = mi.ScalarTransform4f
    lights = {"point": {"type": "point", "position": [0.8, 1.2, 0.6], "intensity": 8.0},
              "directional": {"type": "directional", "direction": [-0.4, -1, -0.3], "irradiance": 2.0}}  # fmt: skip
    grey = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    return mi.load_dict({
        "type": "scene", "lamp": lights[light],
        "camera": {"type": "perspective", "fov": 25, "film": {
                       "type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"},
                       "pixel_format": "luminance"},
                   "to_world": pose().look_at(origin=[0, 0.6, 3], target=[0, 0.3, -0.5], up=[0, 1, 0])},
        "floor": {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": floor},
                  "to_world": pose().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)},
        "wall": {"type": "rectangle", "to_world": pose().translate([0, 0.2, -0.5]).scale(0.9), "bsdf": grey},
        "roof": {"type": "rectangle", "bsdf": grey,
                 "to_world": pose().translate([0, 1.1, -0.1]).rotate([1, 0, 0], 80).scale(0.4)},
    }, optimize=False)  # fmt: skip


MIRROR = {"type": "conductor", "material": "none"}
PLASTIC = {"type": "plastic", "int_ior": 2.5, "diffuse_reflectance": 0.1}  # so that it throws back enough to be seen


def inner_images(scene: mi.Scene, spec: dict, spp: int) -> np.ndarray:
    return images(scene, spec, spp, SEEDS)[:, BORDER:-BORDER, BORDER:-BORDER]


@pytest.mark.parametrize("floor, light", [
    (MIRROR, "point"), (PLASTIC, "directional"), pytest.param(PLASTIC, "point", marks=pytest.mark.slow),
    pytest.param(MIRROR, "directional", marks=pytest.mark.slow),
], ids=["mirror-point", "plastic-directional", "plastic-point", "mirror-directional"])  # fmt: skip
def test_image(llvm, floor, light):
    scene = room(floor, light)
    ours, particles = inner_images(scene, BDPT, 64), inner_images(scene, {"type": "ptracer", **LIMITS}, 512)
    weights = functionals(ours.shape[1:])
    assert np.abs(z_scores(ours, particles, weights)).max() < 5
    without = inner_images(scene, {**BDPT, "light_paths": "off"}, 64)
    assert np.abs(z_scores(without, ours, weights)).max() > 5, "what the floor throws back could have been missing"


def test_area_lights_need_no_such_help(llvm):
    scene = mi.load_dict({
        "type": "scene", "mirror": {"type": "rectangle", "bsdf": MIRROR},
        "card": {"type": "sphere", "radius": 0.1, "center": [0, 0, 1], "emitter": {"type": "area"}},
        "camera": {"type": "perspective", "to_world": mi.ScalarTransform4f().translate([0, 0, 3]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
    })  # fmt: skip
    plan = psdr_jit.make_plan(scene, ["card.to_world"], integrator=BDPT)
    assert not plan.light.runs and "nothing to aim at" in plan.light.reason


@pytest.mark.parametrize(("light", "runs"), [
    also({"type": "sphere", "radius": 0.1, "center": [0, 0, 3], "emitter": {"type": "area"}}, False),
    also({"type": "point", "position": [0, 0, 3]}, True),
], ids=["area", "point"])  # fmt: skip
def test_smooth_shaded_glass_is_left_to_camera_paths_where_they_see_it(llvm, light, runs):
    """Its lobes do not keep étendue: derivatives by light subpaths were off where those by camera paths are not."""
    scene = mi.load_dict({
        "type": "scene", "lamp": light, "camera": {"type": "perspective", "film": {
            "type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "gaussian"}}},
        "ball": {"type": "obj", "filename": str(shipped_scene("meshes/smooth_sphere.obj")),
                 "bsdf": {"type": "dielectric"}},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -5]).scale(9)},
    }, optimize=False)  # fmt: skip
    plan = psdr_jit.make_plan(scene, ["ball.vertex_positions"], integrator=BDPT)
    assert plan.light.runs == runs and (runs or "smooth-shaded" in plan.light.reason)


def test_no_light_is_said_to_be_missing_from_the_image(llvm):
    with pytest.warns(UnsupportedWarning, match="is in the image, but not what mirrors and smooth glass show of it"):
        psdr_jit.make_plan(room(PLASTIC, "point"), ["roof.to_world"], integrator=BDPT)


def test_forward_and_backward_are_transposes(llvm):
    integrator = integrator_specs.build({**BDPT, "form": "spatial", **dict.fromkeys(BUDGETS, 4)})
    wJv, JTwv, w, Jv = adjoint_identity(room(PLASTIC, "point"), "roof.to_world", integrator)
    assert Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"


@pytest.mark.slow
@pytest.mark.parametrize("floor", [MIRROR, PLASTIC], ids=["mirror", "plastic"])
@pytest.mark.parametrize("light, param, how", [
    ("point", "roof.to_world", {"direction": X}), ("directional", "roof.to_world", {"direction": X}),
    ("point", "lamp.position", {"direction": X}), ("point", "floor.to_world", {"direction": (0, 1, 0)}),
    ("directional", "camera.to_world", {"direction": X}),
])  # fmt: skip
def test_what_moves(llvm, floor, light, param, how):
    limits = {"eps": STEP, "max_seconds": 200, "max_stderr": 0.01}
    result = psdr_jit.check_gradient(room(floor, light), param, **how, integrator=BDPT, **limits)
    assert result.passed, str(result)
