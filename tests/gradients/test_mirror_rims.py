"""Smooth-shaded mirrors and glass near their outlines, where light is reflected under the faces of their meshes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward
from test_smooth_meshes import sphere, torus

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

SIZE, SEEDS = 24, 16
STEP, SMALL_TURN = 4e-3, 8e-3
SHIFT = (1.0, 0.3, 0.2)
MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": 0.5}}
BSDFS = {
    "mirror": (MIRROR, 2),
    "glass": ({"type": "dielectric", "int_ior": 1.5}, 3),
    "plastic": ({"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.2}}, 2),
}

#: Of steps: differences of mirrors are known well enough to see what larger ones leave, .6 % of some.
FINER = {"mirror": 0.5}

MOTIONS = {
    "move": ("ball.vertex_positions", {"direction": SHIFT}, STEP),
    "turn": ("ball.vertex_positions", {"rotate": (0.3, 1, 0.2)}, SMALL_TURN),
    "camera": ("camera.to_world", {"direction": SHIFT}, STEP),
}


def look_at(origin, target) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0, 1])


def scene_of(ball: mi.Mesh, **more: dict) -> mi.Scene:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    pose = look_at([0.3, -4, 1], [0, 0, 0])
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant"}, "ball": ball,
        "camera": {"type": "perspective", "fov": 40, "to_world": pose, "film": film}, **more,
    }, optimize=False)  # fmt: skip


def spec(depth: int, **budgets) -> dict:
    return {"type": "psdr_path", "max_depth": depth, "rr_depth": 1000, **budgets}


def check(ball: mi.Mesh, bsdf: str, motion: str, reference_spp: int, spp: int = 256) -> None:
    param, how, step = MOTIONS[motion]
    moved = perturb(scene_of(ball), param, **how)
    depth = BSDFS[bsdf][1]
    reference = fd(moved, spec(depth), FINER.get(bsdf, 1) * step, SEEDS, reference_spp)
    assert_grad_close(forward(moved, spec(depth), SEEDS, spp), reference, max_stderr=0.05)


@pytest.mark.slow
def test_a_ball_that_mirrors_a_sky(llvm):
    """All that can be seen to move are outlines and rims; inside of the ball it is dark."""
    check(sphere(12, bsdf=MIRROR), "mirror", "move", 1024)


def test_rims_of_a_fine_ball(llvm):
    """All of its steps are edges, however narrow: without horizons among them the gain is 2."""
    moved = perturb(scene_of(sphere(64, bsdf=MIRROR)), "ball.vertex_positions", direction=SHIFT)
    reference = fd(moved, spec(2), STEP, SEEDS, 512)
    assert_grad_close(forward(moved, spec(2, sppc=0, sppp=1, spps=0), 8, 64), reference, max_stderr=0.03)


# What turning in place changes is small: of plastic, 3 % of it is missing, by what is thin for a pixel.
CASES = [(bsdf, motion) for bsdf in BSDFS for motion in MOTIONS if (bsdf, motion) != ("plastic", "turn")]


@pytest.mark.slow
@pytest.mark.parametrize("segments", [12, 32])
@pytest.mark.parametrize("bsdf, motion", CASES)
def test_a_ball_under_a_sky(llvm, bsdf, motion, segments):
    ball = sphere(segments, bsdf=BSDFS[bsdf][0])
    check(ball, bsdf, motion, 8192, 1024 if bsdf == "glass" else 256)


@pytest.mark.slow
def test_a_ring_that_mirrors_itself(llvm):
    moved = perturb(scene_of(torus(16, bsdf=MIRROR)), "ball.vertex_positions", direction=SHIFT)
    reference = fd(moved, spec(4), STEP, SEEDS, 8192)
    assert_grad_close(forward(moved, spec(4), SEEDS, 512), reference, max_stderr=0.05)


@pytest.mark.slow
def test_a_ball_in_a_mirror(llvm):
    """Rims that the camera sees by way of another mirror are found by the lines across the film alone."""
    mirror = {"type": "rectangle", "bsdf": {"type": "conductor"},
              "to_world": look_at([0, 2.5, 0], [0, -4, 0.5]).scale(4)}  # fmt: skip
    moved = perturb(scene_of(sphere(12, bsdf=MIRROR), mirror=mirror), "ball.vertex_positions", direction=SHIFT)
    # with STEP, differences are 0.3 % further off than with half of it, which is more than their noise
    reference = fd(moved, spec(3), STEP / 4, SEEDS, 16384)
    assert_grad_close(forward(moved, spec(3), SEEDS, 512), reference, max_stderr=0.05)


def over_a_floor(ball: mi.Mesh) -> mi.Scene:
    """The camera sees a floor alone, which sees the ball mirror the sky: however fine, dark beside its outline."""
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    camera = {"type": "perspective", "fov": 30, "to_world": look_at([2.2, 0, -0.2], [1, 0, -1.2]), "film": film}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(4)}
    return scene_of(ball, floor=floor, camera=camera)


BRIGHT = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": 0.9}}
SEEN_BY_A_FLOOR = {
    "fine": (64, BRIGHT, "move"), "coarse": (8, BRIGHT, "move"), "turned": (12, BRIGHT, "turn"),
    "plastic": (16, {"type": "plastic", "diffuse_reflectance": 0.0, "int_ior": 2.5}, "move"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", SEEN_BY_A_FLOOR)
def test_a_floor_sees_balls(llvm, case):
    segments, surface, motion = SEEN_BY_A_FLOOR[case]
    param, how, step = MOTIONS[motion]
    moved = perturb(over_a_floor(sphere(segments, bsdf=surface)), param, **how)
    reference = fd(moved, spec(3), step, SEEDS, 16384)
    assert_grad_close(forward(moved, spec(3), SEEDS, 1024), reference, max_stderr=0.03)


@pytest.mark.slow
def test_a_floor_sees_as_much_of_a_fine_ball_as_of_a_sphere(llvm):
    """What the outline hides, the horizon within its rim brings back: without it, 50 of the sum is missing.

    Directions turn along with the sphere, and its interior term has a share of that (`paths.orbits`).
    """
    integrator = spec(3, sppc=1, sppp=0, sppd=0, spps=0, sppi=1)
    balls = (sphere(64, bsdf=BRIGHT), "vertex_positions"), ({"type": "sphere", "bsdf": BRIGHT}, "to_world")
    sums = [forward(perturb(over_a_floor(ball), f"ball.{key}", direction=(1, 0, 0)), integrator, 8, 256).sum((1, 2, 3))
            for ball, key in balls]  # fmt: skip
    error = np.hypot(*(s.std(ddof=1) / np.sqrt(len(s)) for s in sums))
    assert error < 3 and abs(sums[0].mean() - sums[1].mean()) < 5 * error


@pytest.mark.parametrize("bsdf", ["mirror", pytest.param("glass", marks=pytest.mark.slow)])
def test_forward_and_backward_agree(llvm, bsdf):
    surface, depth = BSDFS[bsdf]
    integrator = integrator_specs.build(spec(depth, sppc=0, sppp=16, sppi=0, spps=16))
    wJv, JTwv, w, Jv = adjoint_identity(scene_of(sphere(12, bsdf=surface)), "ball.vertex_positions", integrator)
    assert Jv > 1e-3 and abs(wJv - JTwv) <= 1e-6 * w * Jv


def test_forward_and_backward_agree_on_what_a_floor_sees(llvm):
    integrator = integrator_specs.build(spec(3, sppc=0, sppp=0, sppd=0, spps=0, sppi=64))
    wJv, JTwv, w, Jv = adjoint_identity(over_a_floor(sphere(12, bsdf=BRIGHT)), "ball.vertex_positions", integrator)
    assert Jv > 1e-3 and abs(wJv - JTwv) <= 1e-6 * w * Jv


@pytest.mark.slow
def test_a_border_mirrored_at_the_very_rim(llvm):
    """The border of a floor passes behind a ball; what the ball mirrors of it leaves its outline at a tangent.

    The closer to the outline, the less of it is found: half was missing where halving ended at 2^-12 px.
    """
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 20, "height": 20, "pixel_format": "luminance"}
    seen = T().look_at(origin=[0, 2.5, 5], target=[0, 0.6, 0], up=[0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "camera": {"type": "perspective", "fov": 45, "to_world": seen, "film": film},
        "floor": {"type": "rectangle", "to_world": T().scale(3).rotate([1, 0, 0], -90), "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [0.8, 0.6, 0.2], "radius": 0.55, "bsdf": {"type": "conductor"}},
        "lamp": {"type": "point", "position": [0.5, 3.5, 0], "intensity": 12.0},
    }, optimize=False)  # fmt: skip
    motion = perturb(scene, "ball.to_world", (0, 1, 0))
    estimate = forward(motion, {"type": "psdr_path", "max_depth": 3}, 8, 256).mean(0)
    reference = fd(motion, {"type": "path", "max_depth": 3}, 0.004, 8, 8192).mean(0)
    at_rim = [(7, 15), (8, 14), (7, 12)]
    ratio = sum(estimate[p] for p in at_rim) / sum(reference[p] for p in at_rim)
    assert 0.85 < float(ratio[0]) < 1.03
