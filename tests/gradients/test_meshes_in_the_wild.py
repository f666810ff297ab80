"""Meshes as files have them: several bodies in one mesh, pushed into each other; and mirrored between two calls."""

from __future__ import annotations

import warnings
from itertools import combinations

import mitsuba as mi
import numpy as np
import pytest
from fuzz.meshes import box as cube
from helpers import TERMS, assert_grad_close, fd, forward, mesh_of

from benchmarks import meshes
from psdr_jit.derivative.integrator_specs import build
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.statistics import gain

STEP = 0.006  # of finite differences [scene units]: 0.03 px
SEEDS, SPP = 16, 512
TOLERANCE = 0.01
SPEC = {"type": "psdr_path", "max_depth": 2}
MOVED = ("shape.vertex_positions", (1, 0, 0.3))


def leaning(*turns: tuple[float, tuple[float, float, float]]) -> np.ndarray:
    """Rotation (3, 3) by angles [degrees] about axes, the last one first."""
    pose = mi.ScalarTransform4f()
    for angle, axis in turns:
        pose = pose.rotate(axis, angle)
    return np.array(pose.matrix)[:3, :3]


def boxes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A block, and a beam askew through it, as parts of one mesh: the first `count` of them."""
    points, faces = meshes.box(1)
    points = (points - meshes.CENTRE) / meshes.RADIUS
    block, beam = points * (0.6, 0.5, 0.4), points * (0.25, 0.2, 1.0) @ leaning((20, (0, 1, 0))).T + (0.1, -0.1, 0)
    all_of_it = np.concatenate([block, beam][:count]) @ leaning((25, (0, 0, 1)), (15, (1, 0, 0))).T
    return all_of_it, np.concatenate([faces + k * len(points) for k in range(count)])


def ribbon() -> tuple[np.ndarray, np.ndarray]:
    """One connected open surface that cuts itself, with sharp corners: a strip bent as the letter alpha."""
    bends = np.array([(-0.9, -0.45), (0.8, 0.35), (0.8, -0.35), (-0.9, 0.45)])
    points = np.concatenate([np.insert(bends, 2, height, axis=1) for height in (-0.5, 0.5)])
    faces = np.array([t for k in range(3) for t in ((k, k + 1, k + 5), (k, k + 5, k + 4))])
    return points @ leaning((20, (0, 0, 1)), (15, (1, 0, 0))).T, faces


def stack() -> tuple[np.ndarray, np.ndarray]:
    """A small box on a large one, flush in front and not above its end, as parts of one mesh."""
    points, faces = cube(1)
    large, small = points * (0.6, 0.4, 0.3) - (0, 0, 0.3), points * (0.4, 0.25, 0.3) + (0.4, -0.15, 0.3)
    turned = np.concatenate([large, small]) @ leaning((25, (0, 0, 1)), (10, (1, 0, 0))).T
    return turned, np.concatenate([faces, faces + len(points)])


def fins() -> tuple[np.ndarray, np.ndarray]:
    """A block with a sheet on four of its edges, which have three faces then."""
    points, faces = boxes(1)
    ridges = [(i, j) for i, j in combinations(range(len(points)), 2)
              if sum({i, j} <= set(face) for face in faces.tolist()) == 2]  # fmt: skip
    for i, j in sorted(ridges, key=lambda ends: np.linalg.norm(points[ends[0]] - points[ends[1]]))[:4]:
        middle, number = (points[i] + points[j]) / 2, len(points)
        points = np.concatenate([points, points[[i, j]] + 0.4 * middle / np.linalg.norm(middle)])
        faces = np.concatenate([faces, [(i, j, number + 1), (i, number + 1, number)]])
    return points, faces


def scene_of(points: np.ndarray, faces: np.ndarray) -> mi.Scene:
    """The mesh above a floor, under a lamp."""
    grey = {"type": "diffuse", "reflectance": 0.7}
    mesh = mesh_of(points, faces, bsdf={"type": "twosided", "bsdf": grey})
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    view = T().look_at(origin=[1.1, -5, 2.1], target=[0, 0, 0], up=[0, 0, 1])
    floor = {"type": "rectangle", "to_world": T().translate([0, 0.3, -1.2]).scale(3), "bsdf": grey}
    lamp = {"type": "point", "position": [1, -3, 4.5], "intensity": 60.0}
    parts = {"shape": mesh, "floor": floor, "lamp": lamp}
    return mi.load_dict({"type": "scene", "camera": {"type": "perspective", "fov": 26, "to_world": view, "film": film},
                         **parts}, optimize=False)  # fmt: skip


@pytest.mark.slow
def test_bodies_of_one_mesh_that_cut_into_each_other(llvm):
    """The curve where they meet is an edge, though no face ends there."""
    motion = perturb(scene_of(*boxes(2)), *MOVED)
    reference = fd(motion, SPEC, STEP, SEEDS, 4 * SPP)
    slope = gain(forward(motion, SPEC, SEEDS, SPP), reference[0::2], reference[1::2])
    assert slope.stderr < 0.01, slope
    assert abs(slope.value - 1) < max(TOLERANCE, 3 * slope.stderr), slope


@pytest.mark.slow
@pytest.mark.parametrize("shape", [stack, ribbon, fins])
def test_flush_bodies_and_a_surface_that_cuts_itself(llvm, shape):
    """What two edges of a stack have in common is one edge, and so is where three faces meet; deep in a sharp corner it
    is not dark."""
    motion = perturb(scene_of(*shape()), *MOVED)
    reference = fd(motion, SPEC, STEP, SEEDS, 4 * SPP)
    assert_grad_close(forward(motion, SPEC, SEEDS, SPP), reference, 0.01)


@pytest.mark.parametrize("extra", ["again", "turned", "collapsed"])
def test_faces_that_add_nothing_change_nothing(llvm, extra):
    """Faces that repeat others, or have two corners in one place: no warning, and the derivative of the bare block."""
    points, faces = boxes(1)
    more = {"again": faces, "turned": faces[:, ::-1], "collapsed": faces[:, [0, 0, 1]]}[extra]
    # Which face of two is met is a toss, and so are the random numbers of the interior term.
    spec = {**SPEC, **{budget: SPP * (term != "interior") for term, budget in TERMS.items()}}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = [forward(perturb(scene_of(points, f), *MOVED), spec, 1, SPP)
                 for f in (faces, np.concatenate([faces, more]))]  # fmt: skip
    assert np.abs(found[0]).max() > 0.1
    assert np.allclose(*found, rtol=1e-3, atol=1e-3 * np.abs(found[0]).max())


def test_a_mesh_that_is_mirrored_between_two_calls(llvm):
    """Which side of it is outside is found anew: an integrator that knew it before gives what a fresh one does."""
    points, faces = boxes(1)
    fixed = {**SPEC, **dict.fromkeys(TERMS.values(), SPP)}  # budgets that follow the noise remember earlier calls
    scene, used = scene_of(points, faces), build(fixed)

    def derivative(integrator) -> np.ndarray:
        motion = perturb(scene, *MOVED)
        sampler = DerivativeSampler(motion, integrator, 0, SPP, groups=1)
        sampler.add(1)
        motion.restore()
        return sampler.images.mean()

    derivative(used)
    params = mi.traverse(scene)
    params["shape.vertex_positions"] = (points * [-1, 1, 1]).ravel().astype(np.float32)
    params.update()
    fresh = derivative(build(fixed))
    assert np.abs(fresh).max() > 0.1
    assert np.allclose(derivative(used), fresh, rtol=1e-4, atol=1e-4 * np.abs(fresh).max())


@pytest.mark.slow
@pytest.mark.parametrize("painted", [False, True])
def test_faces_that_repeat_others_are_there_once(llvm, painted):
    """Outlines by shading normals, and lines of patterns, on them counted twice."""
    checkers = {"type": "checkerboard", "to_uv": mi.ScalarTransform3f().scale(7)}
    points, faces = meshes.ball(12, 24)
    points = (points - meshes.CENTRE) / meshes.RADIUS
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": checkers if painted else 0.7})
    images = []
    for repeats in (1, 2):  # of all: normals that Mitsuba computes are means over the faces, repeated ones as well
        mesh = meshes.smooth_mesh("ball", points, np.concatenate([faces] * repeats), bsdf)
        if painted:
            mesh.add_attribute("vertex_texcoords", 2, (points[:, :2] / 2 + 0.503).ravel())
        film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
        pose = mi.ScalarTransform4f().look_at([0.3, 1.1, 4], [0, 0, 0], [0, 1, 0])
        sensor = {"type": "perspective", "fov": 35, "to_world": pose, "film": film}
        lamp = {"type": "point", "position": [2, 3, 3], "intensity": 20.0}
        scene = mi.load_dict({"type": "scene", "sensor": sensor, "ball": mesh, "lamp": lamp}, optimize=False)
        images.append(forward(perturb(scene, "sensor.to_world", (1, 0.3, 0.2)), SPEC, 8, 1024).mean(0))
    assert np.linalg.norm(images[0] - images[1]) < 0.01 * np.linalg.norm(images[0])
