"""Boxes, curves, SDF grids, ellipsoids and instances, as mirrors show them: as mirrored copies, seen directly."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close
from test_specular_chain import along, camera, moved_images, rest, turned

from psdr_jit.derivative import integrator_specs


def T():  # noqa: N802 (short, as it is written a dozen times)
    return mi.ScalarTransform4f()


MIRROR = [1, 1, -1]  # the plane z = 0
GREEN = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.7, 0.3]}}
BUDGETS = {"sppc": 128, "sppp": 128, "sppi": 128, "spps": 128}

POINTS = np.array([[-1.3, -0.9, 0.9, 0.16], [-0.7, 0.2, 1.1, 0.15], [-0.1, -0.1, 0.8, 0.1], [0.5, 0.3, 1.1, 0.12],
                   [0.8, -0.4, 0.9, 0.15], [0.6, -1.2, 1.0, 0.16]])  # fmt: skip
QUATERNIONS = np.array([[0.3, 0.5, -0.2, 0.78], [0.1, -0.6, 0.3, 0.73]])
CENTRES, AXES = np.array([[-0.35, -0.2, 0.9], [0.5, 0.3, 1.1]]), np.array([[0.1, 0.16, 0.08], [0.13, 0.06, 0.1]])


def tube(plugin: str, mirrored: bool, folder) -> dict:
    path = folder / f"{plugin}{mirrored}.txt"
    points = POINTS * ([1, 1, -1, 1] if mirrored else 1)
    path.write_text("\n".join(" ".join(map(str, p)) for p in points) + "\n")
    return {"thing": {"type": plugin, "filename": str(path), "bsdf": GREEN}}


def ellipsoids(mirrored: bool, folder) -> dict:
    q = QUATERNIONS / np.linalg.norm(QUATERNIONS, axis=1, keepdims=True)
    if mirrored:  # axes of turns are pseudovectors
        q = q * [-1, -1, 1, 1]
    given = {"centers": CENTRES * (MIRROR if mirrored else 1), "scales": AXES, "quaternions": q}
    tensors = {name: mi.TensorXf(value.astype(np.float32)) for name, value in given.items()}
    return {"thing": {"type": "ellipsoids", **tensors, "bsdf": GREEN}}


def grid(mirrored: bool, folder, normals: str = "analytic", values: int = 7) -> dict:
    z, y, x = np.meshgrid(*[np.linspace(0, 1, values)] * 3, indexing="ij")
    f = np.sqrt(((x - 0.5) / 0.9) ** 2 + (y - 0.5) ** 2 + ((z - 0.45) / 0.8) ** 2) - 0.3 + 0.05 * np.sin(9 * x)
    low, size = 0.4, 1.2
    if mirrored:
        f, low = f[::-1], -low - size
    pose = T().translate([-0.6, -0.7, low]).scale(size)
    values = mi.TensorXf(np.ascontiguousarray(f[..., None], dtype=np.float32))
    return {"thing": {"type": "sdfgrid", "grid": values, "normals": normals, "to_world": pose, "bsdf": GREEN}}


def instances(mirrored: bool, folder) -> dict:
    ball, disk = T().translate([0.4, 0.4, 0]).scale(0.2), T().translate([-0.5, 0.4, 0.3]).rotate([0, 1, 0], 150)
    checks = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    group = {
        "type": "shapegroup",
        "cube": {"type": "cube", "to_world": T().rotate([0.6, 0.8, 0], 30).scale(0.25), "bsdf": checks},
        "ball": {"type": "sphere", "to_world": ball, "bsdf": GREEN},
        "disk": {"type": "disk", "to_world": disk.scale(0.3), "bsdf": {"type": "twosided", "of": GREEN}},
    }
    other = T().translate([0.4, -0.3, 0.5]).rotate([0.6, 0.8, 0], 70).scale(0.7)
    places = {"one": T().translate([-0.4, -0.2, 0.7]).scale(0.7), "other": other}
    flip = T().scale(MIRROR) if mirrored else T()
    shown = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    return {"group": group} | {name: {**shown, "to_world": flip @ place} for name, place in places.items()}


def boxes(mirrored: bool, folder) -> dict:
    """So far from the camera that lines are halved to where rounding decides which face is met at an edge."""
    flip, place = T().scale(MIRROR) if mirrored else T(), T().translate([0.4, -0.3, 0.5]).rotate([0.6, 0.8, 0], 70)
    poses = [T().translate([-0.4, -0.2, 0.7]).rotate([0.6, 0.8, 0], 30).scale(0.18),
             place.rotate([0.6, 0.8, 0], 30).scale(0.18)]  # fmt: skip
    both = {"type": "twosided", "of": GREEN}
    return {f"box{k}": {"type": "cube", "to_world": flip @ pose, "bsdf": both} for k, pose in enumerate(poses)}


SHAPES = {
    "boxes": boxes,
    "spline": lambda *a: tube("bsplinecurve", *a),
    "rods": lambda *a: tube("linearcurve", *a),
    "ellipsoids": ellipsoids,
    "grid": grid,
    "blended": lambda *a: grid(*a, "smooth", 49),
    "instances": instances,
}


def scene_of(shape: str, mirrored: bool, folder) -> mi.Scene:
    """Lit by a point, which is not seen in the mirror. The mirror hides the shape itself from the camera's film."""
    side = -1 if mirrored else 1
    objects = {} if mirrored else {
        "mirror": {"type": "rectangle", "to_world": T().scale(4), "bsdf": {"type": "conductor", "material": "none"}}
    }  # fmt: skip
    lamp = {"type": "point", "position": [0.4, 1.8, side * 0.2], "intensity": 10.0}
    hidden = SHAPES[shape](mirrored, folder)
    view = camera([6, 0.3, 3.2], [0.2, 0, -1], 14)
    return mi.load_dict({"type": "scene", "camera": view, "lamp": lamp, **objects, **hidden}, optimize=False)


@pytest.mark.slow
@pytest.mark.parametrize("motion", [along, turned], ids=["moved", "turned"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_mirror_shows_a_mirrored_copy(llvm, shape, motion, tmp_path):
    images = []
    for mirrored in (False, True):
        scene = scene_of(shape, mirrored, tmp_path)
        at = mi.Transform4f(mi.traverse(scene)["camera.to_world"])
        spec = {"type": "psdr_path", "max_depth": 2 if mirrored else 3, **BUDGETS}
        images.append(moved_images(scene, {"camera.to_world": lambda θ, at=at: motion(θ) @ at}, spec, 128))
    assert_grad_close(*images)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_what_moves_together_stands_still(llvm, shape, tmp_path):
    """Mirror and camera along the plane of the mirror: only what it shows of the rest passes by."""
    scene = scene_of(shape, False, tmp_path)
    params = mi.traverse(scene)
    at = {name: mi.Transform4f(params[f"{name}.to_world"]) for name in ("mirror", "camera")}
    spec = {"type": "psdr_path", "max_depth": 3, "sppc": 0, "sppp": 0, "sppi": 0, "spps": 64}

    def slid(θ):
        return mi.Transform4f().translate(θ * mi.Vector3f(0.6, 0.2, 0))

    alone = {"mirror.to_world": lambda θ: slid(θ) @ at["mirror"], "camera.to_world": lambda θ: rest(θ) @ at["camera"]}
    moved = {"mirror.to_world": alone["mirror.to_world"], "camera.to_world": lambda θ: slid(θ) @ at["camera"]}
    still, signal = (np.abs(moved_images(scene, poses, spec, 64, seeds=4)).max() for poses in (alone, moved))
    assert still < 1e-3 * signal


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_backward_mode_is_the_adjoint(llvm, shape, tmp_path):
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4})
    names = {"boxes": "box0.vertex_positions", "spline": "thing.control_points", "rods": "thing.control_points",
             "ellipsoids": "thing.data", "grid": "thing.to_world", "blended": "thing.to_world"}  # fmt: skip
    for name in ("mirror.to_world", *([names[shape]] if shape in names else [])):
        scene = scene_of(shape, False, tmp_path)
        forwards, backwards, w, jv = adjoint_identity(scene, name, integrator, spp=16)
        assert jv > 0 and abs(forwards - backwards) < 1e-5 * w * jv, name
