"""Instances that rest: a scene with them has the derivative of the same scene with every copy loaded on its own.

Both are rendered with the same random numbers, and differ by rounding where the terms agree.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain

X, UP = (1, 0, 0), (0, 1, 0)
SPP = 128
CLOSE, ALIKE = 0.01, 0.06  # of the gain of one derivative on the other, and of what is left, in its norm
ADJOINT = 1e-5

MATERIAL = {"type": "twosided", "of": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.4, 0.3]}}}
CHECKS = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
CUBE = {"type": "cube"}


def poses(scale: tuple = (1, 1, 1)) -> dict[str, mi.ScalarTransform4f]:
    """Two places; `scale` acts on the shape first."""
    left = mi.ScalarTransform4f().translate([-0.6, 0.5, 0]).rotate([0, 1, 0], 25).scale(0.4)
    right = mi.ScalarTransform4f().translate([0.6, 0.6, 0.2]).rotate([0.6, 0.8, 0], 40).scale(0.35)
    return {"left": left.scale(scale), "right": right.scale(scale)}


def scene_of(instanced: bool, shape=CUBE, scale=(1, 1, 1), material=MATERIAL, **more) -> mi.Scene:
    """Two copies of a shape over a floor, under a lamp, with a small box between them and the lamp."""
    pose = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 20, "height": 20, "rfilter": {"type": "gaussian"}, "pixel_format": "rgb"}
    view = pose().look_at(origin=[0, 2, 5], target=[0, 0.3, 0], up=[0, 1, 0])
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "lamp": {"type": "rectangle", "to_world": pose().translate([1, 4, 1]).rotate([1, 0, 0], 90).scale(0.5),
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}},
        "point": {"type": "point", "position": [-2, 3, 2], "intensity": {"type": "rgb", "value": 10.0}},
        "floor": {"type": "rectangle", "to_world": pose().rotate([1, 0, 0], -90).scale(3),
                  "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}},
        "blocker": {"type": "cube", "to_world": pose().translate([0.1, 1.2, 0.6]).rotate([0.6, 0.8, 0], 30).scale(0.2)},
        "material": material,
        **more,
    }  # fmt: skip
    shared, places = {"type": "ref", "id": "material"}, poses(scale)
    if instanced:
        scene["group"] = {"type": "shapegroup", "of": {**shape, "bsdf": shared}}
        shown = {"type": "instance", "group": {"type": "ref", "id": "group"}}
        scene |= {name: {**shown, "to_world": place} for name, place in places.items()}
    else:
        scene |= {name: {**shape, "to_world": place, "bsdf": shared} for name, place in places.items()}
    return mi.load_dict(scene, optimize=False)


def derivative(scene: mi.Scene, param: str, how: dict, depth: int, form: str = "auto") -> np.ndarray:
    return forward(perturb(scene, param, **how), {"type": "psdr_path", "max_depth": depth, "form": form}, 1, SPP)[0]


def assert_alike(param: str, how: dict, depth: int, form: str = "auto", **what) -> None:
    alone, shown = (derivative(scene_of(i, **what), param, how, depth, form) for i in (False, True))
    power = np.sum(alone**2)
    assert power > 0
    slope = np.sum(alone * shown) / power
    rest = np.sqrt(np.sum((shown - slope * alone) ** 2) / power)
    assert abs(slope - 1) < CLOSE and rest < ALIKE, f"gain {slope:.4f}, rest {rest:.4f}"


WAYS = {
    "camera-moved": ("camera.to_world", {"direction": X}),
    "camera-turned": ("camera.to_world", {"rotate": UP}),
    "area-light": ("lamp.to_world", {"direction": X}),
    "point-light": ("point.position", {"direction": X}),
    "another-mesh": ("blocker.vertex_positions", {"direction": X}),
    "floor-material": ("floor.bsdf.reflectance.value", {}),
    "own-material": ("material.brdf_0.reflectance.value", {}),
    "radiance": ("lamp.emitter.radiance.value", {}),
}
FAST = ("own-material", "radiance")


@pytest.mark.parametrize("way", [way if way in FAST else pytest.param(way, marks=pytest.mark.slow) for way in WAYS])
def test_seen_and_lit_directly(llvm, way):
    assert_alike(*WAYS[way], depth=2)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("way", ["camera-moved", "area-light", "another-mesh", "own-material"])
def test_between_copies(llvm, way, form):
    assert_alike(*WAYS[way], depth=3, form=form)


@pytest.mark.slow
def test_a_mesh_moves_behind_them(llvm):
    behind = mi.ScalarTransform4f().translate([0.1, 0.5, -0.8]).scale(0.3)
    assert_alike(*WAYS["another-mesh"], depth=3, blocker={"type": "cube", "to_world": behind})


def ball(folder) -> str:
    """A coarse smooth-shaded sphere, as a file."""
    name = str(folder / "ball.ply")
    angles = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 16, endpoint=False), indexing="ij")
    θ, φ = (a.ravel() for a in angles)
    points = np.stack([np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)], -1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(8), np.arange(16), indexing="ij"))
    a, b, c, d = (u * 16 + v for u, v in ((i, j), (i, (j + 1) % 16), (i + 1, (j + 1) % 16), (i + 1, j)))
    faces = np.concatenate([np.stack([a, b, c], 1)[i > 0], np.stack([a, c, d], 1)[i < 7]])
    mesh = mi.Mesh("ball", len(points), len(faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    mesh.write_ply(name)
    return name


EVEN, STRETCHED, MIRRORED = (1, 1, 1), (1, 0.6, 1.4), (-1, 1, 1)
SHAPES = {
    "sphere": ({"type": "sphere"}, EVEN, MATERIAL),
    "cylinder": ({"type": "cylinder", "radius": 0.5}, EVEN, MATERIAL),
    "stretched-disk": ({"type": "disk"}, STRETCHED, MATERIAL),
    "rectangle": ({"type": "rectangle"}, EVEN, MATERIAL),
    "mirrored": (CUBE, MIRRORED, MATERIAL),
    "inside-out": ({"type": "cube", "flip_normals": True}, EVEN, MATERIAL),
    "checks": (CUBE, EVEN, CHECKS),
    "checked-ball": ({"type": "sphere"}, EVEN, CHECKS),
    "smooth": ("ball", EVEN, MATERIAL),
    "smooth-mirrored": ("ball", MIRRORED, MATERIAL),
    "smooth-stretched": ("ball", STRETCHED, MATERIAL),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_shapes_and_materials(llvm, name, tmp_path):
    shape, scale, material = SHAPES[name]
    shape = {"type": "ply", "filename": ball(tmp_path)} if shape == "ball" else shape
    assert_alike(*WAYS["camera-turned"], depth=2, shape=shape, scale=scale, material=material)


@pytest.mark.slow
def test_against_finite_differences(llvm):
    motion = perturb(scene_of(True), "camera.to_world", direction=X)
    spec = {"type": "psdr_path", "max_depth": 2}
    reference = fd(motion, spec, 0.01, 64, 1024)
    slope = gain(forward(motion, spec, 8, 512), reference[0::2], reference[1::2])
    assert slope.stderr < 0.01 and abs(slope.value - 1) < 0.01 + 2 * slope.stderr, slope


@pytest.mark.slow
@pytest.mark.parametrize("way", ["camera-moved", "another-mesh", "own-material"])
def test_forward_and_backward_are_transposes(llvm, way):
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3})
    wJv, JTwv, w, Jv = adjoint_identity(scene_of(True), WAYS[way][0], integrator)
    assert Jv > 1e-6 and abs(wJv - JTwv) <= ADJOINT * w * Jv, (wJv, JTwv)


@pytest.mark.slow
def test_an_instance_that_was_moved_between_calls(llvm):
    """Nothing that an integrator remembers is of the old place."""
    place = mi.ScalarTransform4f().translate([0.3, 0.2, 0.4]) @ poses()["left"]
    images = []
    for been_there in (False, True):
        scene, integrator = scene_of(True), integrator_specs.build({"type": "psdr_path", "max_depth": 2})
        before = rendered(scene, integrator) if been_there else None
        params = mi.traverse(scene)
        params["left.to_world"] = mi.Transform4f(place)
        params.update()
        images.append(rendered(scene, integrator))
    fresh, moved = images
    size = np.linalg.norm(fresh)
    assert np.linalg.norm(moved - fresh) < 0.1 * size
    assert np.linalg.norm(before - fresh) > 0.3 * size


def rendered(scene: mi.Scene, integrator: mi.Integrator) -> np.ndarray:
    motion = perturb(scene, "camera.to_world", direction=X)
    motion.attach()
    image = np.array(integrator.render_forward(scene, motion.params, seed=1, spp=SPP))
    motion.restore()
    return image
