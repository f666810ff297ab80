"""Edges seen through delta vertices: in a mirror, behind glass.

What is known without finite differences: a plane mirror shows a mirrored copy, what moves together stands still, and a
slab that slides within its plane changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward
from test_smooth_meshes import sphere

from psdr_jit import make_plan
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import gain

SIZE, SEEDS = 16, 16
ALONE = {"sppc": 0, "sppp": 0, "sppi": 0, "spps": 64}  # the chains alone
BUDGETS = {"sppc": 64, "sppp": 64, "sppi": 64, "spps": 64}
PICTURE = np.random.default_rng(3).uniform(0.2, 1.5, (5, 5, 3)).astype(np.float32)
FLIP = [-1, 1, 1]  # leaves a rectangle where it is, and turns its front to the other side
TOLERANCE = 0.01  # accepted error of a gain
WIDTH = 0.45  # half of that of a card, five pixels

BOX = {"rfilter": {"type": "box"}}
CROP = {"crop_offset_x": 2, "crop_offset_y": 3, "crop_width": 9, "crop_height": 11}
SENSORS = {
    "filter": {"film": {"rfilter": {"type": "gaussian"}, "sample_border": True}},
    "crop": {"film": {"rfilter": {"type": "tent"}, **CROP}},
    "lens": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0},
    "parallel": {"type": "orthographic"},
}


def card(pose, picture: np.ndarray = PICTURE) -> dict:
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(picture)), "raw": True, "wrap_mode": "clamp"}
    return {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": texture}}


def camera(origin, target, fov: float, film: dict | None = None, **more) -> dict:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "luminance", **(film or BOX)}
    pose = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
    if more.get("type") == "orthographic":
        return {"to_world": pose @ mi.ScalarTransform4f().scale([0.9, 0.9, 1]), "film": film, **more}
    return {"type": "perspective", "fov": fov, "to_world": pose, "film": film, **more}


def in_mirror(width: float = WIDTH, **more) -> dict:
    """A card that is seen in a mirror alone."""
    pose = mi.ScalarTransform4f().translate([-1.3, 0.05, 1.0]).rotate([0.3, 1, 0.2], 160).scale([width, 0.35, 1])
    mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": {"type": "conductor"}}
    return {
        "type": "scene",
        "camera": camera([1.2, -0.2, 3], [-0.05, 0, 0], 25, **more),
        "mirror": mirror,
        "card": card(pose),
    }


def behind_glass(glass: dict | mi.Mesh) -> mi.Scene:
    pose = mi.ScalarTransform4f().translate([0.1, 0, -2]).scale(0.9)
    scene = {"type": "scene", "camera": camera([0.3, 0.2, 4], [0, 0, 0], 34), "glass": glass, "card": card(pose)}
    return mi.load_dict(scene, optimize=False)


def moved_images(
    scene: mi.Scene, poses: dict[str, Callable], integrator: dict, spp: int, seeds: int = SEEDS
) -> np.ndarray:
    """Derivative images (seeds, H, W, C) with the parameters `poses` set to functions of θ."""
    params, built, images = mi.traverse(scene), mi.load_dict(integrator), []
    for seed in range(seeds):
        θ = mi.Float(0)
        dr.enable_grad(θ)
        for name, pose in poses.items():
            params[name] = pose(θ)
            params.set_dirty(name)
        params.update()
        dr.forward(θ, dr.ADFlag.ClearEdges)
        images.append(np.array(built.render_forward(scene, None, seed=seed, spp=spp), dtype=np.float64))
    return np.stack(images)


def along(θ: mi.Float) -> mi.Transform4f:
    return mi.Transform4f().translate(θ * mi.Vector3f(0.6, 0.2, 0.5))


def turned(θ: mi.Float) -> mi.Transform4f:
    return mi.Transform4f().rotate(mi.Vector3f(0.3, 1, 0.1), dr.rad2deg(θ))


def rest(θ: mi.Float) -> mi.Transform4f:
    return mi.Transform4f()


MIRROR_CASES = {  # motions of card, mirror and camera
    "card": (along, rest, rest),
    "mirror": (rest, along, rest),
    "mirror-turned": (rest, turned, rest),
    "camera": (rest, rest, along),
    "camera-turned": (rest, rest, turned),
}


def mirrored(case: str, width: float, spp: int, **more) -> tuple[np.ndarray, np.ndarray]:
    """Derivative images `(in the mirror, of the mirrored copy)` of a card of half the `width`, by seeds.

    The copy is seen directly, where the mirror is a window.
    """
    description = in_mirror(width, **more)
    seen = mi.load_dict(description, optimize=False)
    mirror, flip = mi.Transform4f().scale([1, 1, -1]), mi.Transform4f().scale(FLIP)
    description.pop("mirror")
    description["card"] = card(description["card"]["to_world"], PICTURE[:, ::-1])
    copy = mi.load_dict(description, optimize=False)
    of_card, of_mirror, of_camera = MIRROR_CASES[case]
    poses = mi.traverse(seen)
    at = {name: mi.Transform4f(poses[f"{name}.to_world"]) for name in ("card", "mirror", "camera")}

    def copied(θ):
        """The mirror is the plane z = 0, moved."""
        moved = of_mirror(θ)
        return moved @ mirror @ moved.inverse() @ of_card(θ) @ at["card"] @ flip

    motions = {"card": of_card, "mirror": of_mirror, "camera": of_camera}
    moved = {f"{name}.to_world": lambda θ, name=name: motions[name](θ) @ at[name] for name in motions}
    in_copy = {"card.to_world": copied, "camera.to_world": moved["camera.to_world"]}
    spec = {"type": "psdr_path", **dict.fromkeys(BUDGETS, spp)}
    estimate = moved_images(seen, moved, {**spec, "max_depth": 2}, spp)
    return estimate, moved_images(copy, in_copy, {**spec, "max_depth": 1}, spp)


@pytest.mark.slow
@pytest.mark.parametrize("case", MIRROR_CASES)
def test_a_mirror_shows_a_mirrored_copy(llvm, case):
    assert_grad_close(*mirrored(case, WIDTH, 64))


@pytest.mark.slow
def test_what_is_narrower_than_a_pixel_is_found(llvm):
    """Both of its sides cross a line within one pixel: without a second look the gain is 0.86."""
    assert_grad_close(*mirrored("card", 0.02, 2048), max_stderr=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("case", ["mirror-turned", "camera"])
def test_other_sensors(llvm, case, sensor):
    """A filter wider than a pixel, a crop of the film, a lens, parallel projection."""
    assert_grad_close(*mirrored(case, WIDTH, 128, **SENSORS[sensor]))


@pytest.mark.slow
@pytest.mark.parametrize("what", ["mirror", "ball"])
def test_what_moves_together_stands_still(llvm, what):
    names = ["card", "camera", "mirror" if what == "mirror" else "glass"]
    scene = mi.load_dict(in_mirror(), optimize=False) if what == "mirror" else behind_glass(ball())
    poses = mi.traverse(scene)
    at = {name: mi.Transform4f(poses[f"{name}.to_world"]) for name in names}
    moved = {f"{n}.to_world": lambda θ, n=n: along(θ) @ turned(θ) @ at[n] for n in names}
    alone = {name: pose if name.startswith("card") else (lambda θ, n=name[:-9]: at[n]) for name, pose in moved.items()}
    spec = {"type": "psdr_path", "max_depth": 4, **ALONE}
    together = moved_images(scene, moved, spec, 64)
    signal = np.abs(moved_images(scene, alone, spec, 64)).max()
    assert np.abs(together).max() < 1e-3 * signal


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["light", "diffuse"])
def test_a_smooth_mesh_in_a_mirror(llvm, kind):
    """It is black where its shading normals turn away: that outline counts, not that of the mesh."""
    shape = sphere(16, **({"emitter": {"type": "area"}} if kind == "light" else {"bsdf": {"type": "diffuse"}}))
    params = mi.traverse(shape)
    points = np.array(params["vertex_positions"]).reshape(-1, 3) * WIDTH + [-1.3, 0.05, 1.0]
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params.update()
    lamp = {} if kind == "light" else {"lamp": {"type": "point", "position": [0.5, 0.9, 0.6], "intensity": 5.0}}
    description = {**in_mirror(), "card": shape, **lamp}
    motion = perturb(mi.load_dict(description, optimize=False), "card.vertex_positions", direction=(1, 0, 0))
    assert_gain(motion, 2 if kind == "light" else 3, 0.004)


def ball() -> dict:
    return {"type": "sphere", "radius": 0.8, "bsdf": {"type": "dielectric", "int_ior": 1.5}}


def slab() -> dict:
    pose = mi.ScalarTransform4f().scale([3, 3, 0.2])
    return {"type": "cube", "to_world": pose, "bsdf": {"type": "dielectric", "int_ior": 1.5}}


def cube() -> dict:
    pose = mi.ScalarTransform4f().rotate([0.2, 1, 0.1], 25).scale([0.8, 0.8, 0.3])
    return {"type": "cube", "to_world": pose, "bsdf": {"type": "dielectric", "int_ior": 1.5}}


def smooth_ball() -> mi.Mesh:
    shape = sphere(48, bsdf={"type": "dielectric", "int_ior": 1.5})
    params = mi.traverse(shape)
    params["vertex_positions"] = params["vertex_positions"] * 0.8
    params.update()
    return shape


@pytest.mark.slow
def test_a_slab_that_slides_in_its_plane(llvm):
    """Nothing changes; what it does when it turns shows that it is seen."""
    scene = behind_glass(slab())
    spec = {"type": "psdr_path", "max_depth": 4, **BUDGETS}
    still = forward(perturb(scene, "glass.vertex_positions", direction=(1, 0.5, 0)), spec, 2, 64)
    turns = forward(perturb(scene, "glass.vertex_positions", rotate=(0, 1, 0)), spec, 2, 64)
    assert np.abs(still).max() < 1e-4 * np.abs(turns).max()


GLASS = {
    "cube-card": (cube, "card.to_world", 0.003),
    "cube": (cube, "glass.vertex_positions", 0.003),
    "ball-card": (ball, "card.to_world", 0.001),
    "ball": (ball, "glass.to_world", 0.002),
    "smooth-ball-card": (smooth_ball, "card.to_world", 0.001),
    "smooth-ball": (smooth_ball, "glass.vertex_positions", 0.002),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", GLASS)
def test_a_picture_behind_glass(llvm, case):
    glass, name, step = GLASS[case]
    assert_gain(perturb(behind_glass(glass()), name, direction=(1, 0, 0)), 6, step)


def assert_gain(motion: Perturbation, depth: int, step: float):
    """The derivative's gain against finite differences is 1 up to `TOLERANCE` and its error."""
    spec = {"type": "psdr_path", "max_depth": depth, **dict.fromkeys(BUDGETS, 512)}
    reference = fd(motion, spec, step, 64, 4096)
    slope = gain(forward(motion, spec, 2 * SEEDS, 512), reference[0::2], reference[1::2])
    assert slope.stderr < TOLERANCE, slope
    assert abs(slope.value - 1) < TOLERANCE + 2 * slope.stderr, slope


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "mirror.to_world",
    "camera.to_world",
    "card.to_world",
    "glass.to_world",
    "glass.vertex_positions",
])  # fmt: skip
def test_backward_mode_is_the_adjoint(llvm, name):
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, **ALONE})
    if name.startswith("glass"):
        scene = behind_glass(ball() if name.endswith("to_world") else smooth_ball())
    else:
        scene = mi.load_dict(in_mirror(), optimize=False)
    forwards, backwards, w, jv = adjoint_identity(scene, name, integrator, spp=64)
    assert jv > 0
    assert abs(forwards - backwards) < 1e-5 * w * jv


def test_it_is_left_out_without_mirrors_and_glass(llvm):
    spec = {"type": "psdr_path", **BUDGETS}
    description = in_mirror()
    plan = make_plan(mi.load_dict(description, optimize=False), ["card.to_world"], integrator=spec)
    assert plan.term("chain").runs
    description["mirror"]["bsdf"] = {"type": "roughconductor"}
    plan = make_plan(mi.load_dict(description, optimize=False), ["card.to_world"], integrator=spec)
    assert not plan.term("chain").runs and "no surface is a mirror" in plan.term("chain").reason
