"""Shapes whose inner side is seen: open tubes lit through their end, disks and rectangles from both sides, a ball from
within.

The scenes are large for the shape (a wide, distant light): rays beside an edge then pass it at a larger distance, and a
step back along the ray that is measured by the shape alone no longer clears the bulge of its surface.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward, mesh_of

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import Unseen, block_means, block_test, gain

SEEDS = 16
# A camera at a distance sees corners and rims of a pixel's width: with three times this step, finite differences
# themselves are off by 1.5 % (by 0.7 % with this one, by nothing with a third of it).
# Steps of finite differences [scene units, rad], 0.03 px at most, and their samples for each one of ours: the smaller
# the step, the more.
STEP, TURN, PAN = (0.004, 4), (0.004, 4), (0.0003, 24)
BLOCK = 4  # [px]
MAX_Z = 5.0  # standard errors of a block
FLOOR = 0.01  # of the brightest block: what finite differences of a few pixels' step are off themselves
TOLERANCE = 0.01

GREY = {"type": "diffuse", "reflectance": 0.7}
TWO_SIDED = {"type": "twosided", "bsdf": GREY}
GLOW = {"type": "area", "radiance": 1.0}
TILTED = 35, 20  # the axis leans towards viewer and light
EDGE_ON = 62, 8

CAMERA = {"origin": [1.1, -5, 2.1], "target": [0, 0, 0], "up": [0, 0, 1]}, 26
INSIDE = {"origin": [0.3, -1.2, 0.2], "target": [0, 1, 0.1], "up": [0, 0, 1]}, 60


def leaning(about_x: float, about_y: float) -> mi.ScalarTransform4f:
    """A pose whose z axis is turned by so many degrees."""
    return mi.ScalarTransform4f().rotate([1, 0, 0], about_x).rotate([0, 1, 0], about_y)


def cylinder(**children) -> dict:
    ends = {"p0": [0, 0, -0.7], "p1": [0, 0, 0.7]}
    return {"type": "cylinder", **ends, "radius": 0.6, "to_world": leaning(*TILTED), **children}


def flat(plugin: str, pose: tuple[float, float] = TILTED) -> dict:
    return {"type": plugin, "to_world": leaning(*pose), "bsdf": TWO_SIDED}


def open_mesh(points: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    """A two-sided mesh in the same pose."""
    return mesh_of(points @ np.array(leaning(*TILTED).matrix)[:3, :3].T, faces, bsdf=TWO_SIDED)


def tube(segments: int = 24) -> mi.Mesh:
    φ, i = 2 * np.pi * np.arange(segments) / segments, np.arange(segments)
    ring = 0.6 * np.stack([np.cos(φ), np.sin(φ), 0 * φ], 1)
    j = (i + 1) % segments
    faces = [np.stack([i, j, j + segments], 1), np.stack([i, j + segments, i + segments], 1)]
    return open_mesh(np.concatenate([ring - [0, 0, 0.7], ring + [0, 0, 0.7]]), np.concatenate(faces))


def half_box() -> mi.Mesh:
    """A box without its lid."""
    points = np.array([[x, y, z] for z in (-0.6, 0.6) for y in (-0.6, 0.6) for x in (-0.6, 0.6)])
    quads = np.array([[0, 1, 3, 2], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return open_mesh(points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


SHAPES = {  # shape, what surrounds it, camera
    "cylinder": (lambda: cylinder(bsdf=TWO_SIDED), {}, CAMERA),
    "outer": (lambda: cylinder(bsdf=GREY), {}, CAMERA),
    "inner": (lambda: cylinder(bsdf=GREY, flip_normals=True), {}, CAMERA),
    "glowing": (lambda: cylinder(bsdf=GREY, flip_normals=True, emitter=GLOW), {}, CAMERA),
    "disk": (lambda: flat("disk"), {}, CAMERA),
    "disk-edge-on": (lambda: flat("disk", EDGE_ON), {}, CAMERA),
    "rectangle": (lambda: flat("rectangle"), {}, CAMERA),
    "ball": (
        lambda: {"type": "sphere", "radius": 3.0, "bsdf": TWO_SIDED},
        {"block": {"type": "sphere", "radius": 0.4, "center": [0.2, 0.6, 0.1], "bsdf": GREY}},
        INSIDE,
    ),
    "tube": (tube, {}, CAMERA),
    "half-box": (half_box, {}, CAMERA),
}


def light(kind: str, inside: bool) -> dict:
    """A lamp, a wide and distant area light, or a sky; inside of the shape a lamp."""
    if kind == "sky":
        return {"type": "constant", "radiance": 1.0}
    if inside:
        return {"type": "point", "position": [0.5, -0.6, 0.9], "intensity": 5.0}
    if kind == "point":
        return {"type": "point", "position": [1, -3, 4.5], "intensity": 60.0}
    pose = mi.ScalarTransform4f().look_at(origin=[3, -9, 13.5], target=[0, 0, 0], up=[0, 1, 0]).scale(2.1)
    black = {"type": "diffuse", "reflectance": 0.0}
    return {"type": "rectangle", "to_world": pose, "bsdf": black, "emitter": {"type": "area", "radiance": 15.0}}


def assert_agrees(name: str, kind: str, depth: int, param: str, step: tuple[float, int], spp: int = 1024, **how):
    """Gain and blocks of the derivative image agree with finite differences."""
    shape, around, (view, fov) = SHAPES[name]
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    camera = {"type": "perspective", "fov": fov, "to_world": mi.ScalarTransform4f().look_at(**view), "film": film}
    lamp = light(kind, view is INSIDE[0])
    parts = {"shape": shape(), "camera": camera, "light": lamp, **around}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    if param == "shape":
        param = "shape.to_world" if "shape.to_world" in mi.traverse(scene) else "shape.vertex_positions"
    motion = perturb(scene, param, **how)
    spec = {"type": "psdr_path", "max_depth": depth, "rr_depth": 1000}
    estimate = forward(motion, spec, SEEDS, spp)
    size, samples = step
    reference = fd(motion, spec, size, SEEDS, samples * spp)
    slope = gain(estimate, reference[0::2], reference[1::2])
    assert slope.stderr < 0.02, slope
    assert abs(slope.value - 1) < max(TOLERANCE, 3 * slope.stderr), slope
    floor = FLOOR * np.abs(block_means(reference.mean(0), BLOCK)).max()
    assert block_test(estimate, reference, BLOCK, Unseen(floor)).max_z < MAX_Z


LIGHTS = [("point", 2), ("area", 2), ("area", 4), ("sky", 2), ("sky", 3)]
# no sky is seen from within a closed ball
CASES = [(name, kind, depth) for name in SHAPES for kind, depth in LIGHTS if (name, kind) != ("ball", "sky")]


@pytest.mark.slow
def test_a_tube_under_a_turning_camera(llvm):
    assert_agrees("cylinder", "area", 2, "camera.to_world", PAN, rotate=(0, 0.2, 1))


@pytest.mark.slow
def test_a_tube_that_moves(llvm):
    assert_agrees("cylinder", "area", 2, "shape", STEP, direction=(1, 0, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("name, kind, depth", CASES)
def test_a_camera_that_turns(llvm, name, kind, depth):
    assert_agrees(name, kind, depth, "camera.to_world", PAN, 4096, rotate=(0, 0.2, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name, kind, depth", CASES)
def test_a_shape_that_moves(llvm, name, kind, depth):
    assert_agrees(name, kind, depth, "shape", STEP, 4096, direction=(1, 0, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("name, kind, depth", [case for case in CASES if case[0] != "ball"])  # it stays as it is
def test_a_shape_that_turns(llvm, name, kind, depth):
    assert_agrees(name, kind, depth, "shape", TURN, 4096, rotate=(0.3, 1, 0))


def test_the_outer_wall_hides_the_inner_one(llvm):
    """Light from above ends on the inner wall of an upright tube, along a line that passes behind both its outlines:
    as close behind the outer wall as one likes, and never seen from the side."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -4, 0.1], target=[0, 0, 0], up=[0, 0, 1])
    scene = mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 30, "to_world": pose, "film": film},
        "tube": {"type": "cylinder", "p0": [0, 0, -0.7], "p1": [0, 0, 0.7], "radius": 0.6, "bsdf": TWO_SIDED},
        "lamp": {"type": "point", "position": [1.3, -1.5, 2.5], "intensity": 20.0},
    }, optimize=False)  # fmt: skip
    motion = perturb(scene, "camera.to_world", direction=(1, 0.3, 0.2))
    shadows = {"type": "psdr_path", "max_depth": 2, "sppc": 0, "sppp": 0}
    assert not forward(motion, shadows, 1, 1024).any()
