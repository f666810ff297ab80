"""Delta lobes on the way of a path: how it bends with them, and the edges it meets before and behind them.

The camera sees the wall alone, or the specular surface fills its view: edges in a mirror are another term's.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain

SHIFT, TURN = (0.3, 0.5, 0.4), (0.3, 0.8, 0.2)
STEP, SMALL_TURN = 0.01, 0.001  # of finite differences [scene units, rad]
SEEDS = 8

DIELECTRIC, PLASTIC = {"type": "dielectric"}, {"type": "twosided", "bsdf": {"type": "plastic"}}
HALF = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}
NOTHING = {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}
WHITE = {"type": "diffuse", "reflectance": 0.8}


def T():
    return mi.ScalarTransform4f()


def look(origin, target) -> mi.ScalarTransform4f:
    return T().look_at(origin=origin, target=target, up=[0, 1, 0.1])


def camera(origin, target, fov: float) -> dict:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    return {"type": "perspective", "fov": fov, "film": film, "to_world": look(origin, target)}


def picture() -> dict:
    """Light that varies smoothly."""
    texels = np.random.default_rng(0).random((8, 8, 1)).astype(np.float32)
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True,
                                         "filter_type": "bilinear", "wrap_mode": "mirror"}}  # fmt: skip


def wide(z: float, angle: float, **children) -> dict:
    return {"type": "rectangle", "to_world": T().translate([0, 0, z]).rotate([0, 1, 0], angle).scale(9), **children}


def filling(bsdf: dict, plugin: str = "rectangle") -> mi.Scene:
    """A surface that fills the view, pictures before and behind it."""
    poses = {
        "rectangle": T().rotate([0.6, 0.8, 0], 10).scale(2),
        "cube": T().rotate([0.6, 0.8, 0], 15).scale([3, 3, 0.3]),
        "sphere": T().scale(2.5),
    }
    return mi.load_dict({
        "type": "scene", "camera": camera([0, 0, 3], [0, 0, 0], 25),
        "glass": {"type": plugin, "to_world": poses[plugin], "bsdf": bsdf},
        "front": wide(6, 180, emitter=picture()), "back": wide(-6, 0, emitter=picture()),
    }, optimize=False)  # fmt: skip


def pane(bsdf: dict, plugin: str = "rectangle") -> mi.Scene:
    """Something between a lamp and a wall; only the wall is seen."""
    pose = T().translate([0.2, 0.1, 1.2]).rotate([0.6, 0.8, 0], 20).scale(0.5)
    if plugin == "cube":
        pose = pose @ T().scale([1, 1, 0.2])
    lamp = {"type": "rectangle", "to_world": look([0.9, 0.3, 2.6], [0, 0, 0]).scale(0.7), "emitter": {"type": "area"}}
    return mi.load_dict({
        "type": "scene", "camera": camera([-4, 0, 1.2], [-0.2, 0, -0.05], 18),
        "wall": {"type": "rectangle", "to_world": T().scale(1.5), "bsdf": WHITE},
        "glass": {"type": plugin, "to_world": pose, "bsdf": bsdf}, "lamp": lamp,
    }, optimize=False)  # fmt: skip


def spec(depth: int, **budgets) -> dict:
    return {"type": "psdr_path", "max_depth": depth, "rr_depth": 1000, **budgets}


@pytest.mark.parametrize(
    "bsdf, plugin, param, how, step",
    [
        pytest.param({"type": "conductor"}, "rectangle", "glass.to_world", {"rotate": TURN}, SMALL_TURN,
                     marks=pytest.mark.slow),
        pytest.param(DIELECTRIC, "sphere", "glass.to_world", {"direction": SHIFT}, STEP, marks=pytest.mark.slow),
        pytest.param(DIELECTRIC, "cube", "glass.vertex_positions", {"rotate": TURN}, SMALL_TURN,
                     marks=pytest.mark.slow),
        pytest.param({"type": "thindielectric"}, "rectangle", "camera.to_world", {"direction": SHIFT}, STEP,
                     marks=pytest.mark.slow),
        pytest.param(PLASTIC, "rectangle", "camera.to_world", {"direction": SHIFT}, STEP, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_pictures_in_mirrors_and_glass(llvm, bsdf, plugin, param, how, step):
    """Nothing appears or disappears: directions follow the surface."""
    motion = perturb(filling(bsdf, plugin), param, **how)
    reference = fd(motion, spec(4), step, 2 * SEEDS, 1024)
    slope = gain(forward(motion, spec(4), SEEDS, 256), reference[::2], reference[1::2])
    assert abs(slope.value - 1) < 0.005 + 4 * slope.stderr and slope.stderr < 0.01


def test_what_is_not_there_casts_no_shadow(llvm):
    """A pane that lets all light through: what its outline takes from the direct light, it gives to the indirect."""
    motion = perturb(pane(NOTHING), "glass.to_world", direction=SHIFT)
    terms = ({"sppd": 1, "sppi": 0}, {"sppd": 0, "sppi": 1})
    direct, indirect = (forward(motion, spec(3, sppc=0, sppp=0, **t), SEEDS, 512) for t in terms)
    assert_grad_close(-indirect, direct, max_stderr=0.03)


@pytest.mark.slow
def test_glass_that_cuts_into_a_floor(llvm):
    """Right above the cut, what leaves the glass starts below the floor: it must not see the sky there."""
    pose = T().translate([0.1, 0, 0.1]).rotate([0.6, 0.8, 0.3], 40).scale(0.4)
    scene = mi.load_dict({
        "type": "scene", "camera": camera([-1, -2, 3], [0.1, 0, 0], 22), "sky": {"type": "constant"},
        "floor": {"type": "rectangle", "to_world": T().scale(2), "bsdf": WHITE},
        "glass": {"type": "cube", "to_world": pose, "bsdf": DIELECTRIC},
    }, optimize=False)  # fmt: skip
    motion = perturb(scene, "floor.to_world", direction=(0.2, 0.1, 1))
    reference = fd(motion, spec(3), STEP, 2 * SEEDS, 512)
    assert_grad_close(forward(motion, spec(3), SEEDS, 128), reference, max_stderr=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("bsdf, plugin", [(DIELECTRIC, "sphere"), (PLASTIC, "rectangle")])
def test_forward_and_backward_agree(llvm, bsdf, plugin):
    integrator = integrator_specs.build(spec(4, sppc=16, sppp=16, sppd=16, sppi=64))
    wJv, JTwv, w, Jv = adjoint_identity(pane(bsdf, plugin), "glass.to_world", integrator)
    assert Jv > 1e-3 and abs(wJv - JTwv) <= 1e-6 * w * Jv


@pytest.mark.slow
@pytest.mark.parametrize("param", ["glass", "lamp"])
@pytest.mark.parametrize("bsdf", [HALF, PLASTIC], ids=["mask", "plastic"])
def test_edges_before_and_behind(llvm, bsdf, param):
    motion = perturb(pane(bsdf), f"{param}.to_world", direction=SHIFT)
    reference = fd(motion, spec(4), STEP, 4 * SEEDS, 4096)
    assert_grad_close(forward(motion, spec(4), 2 * SEEDS, 2048), reference, max_stderr=0.035)
