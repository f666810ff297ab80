"""Latents and the parameters that follow from them: values, derivatives, constraints, starts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from inverse_problems import BOX, scene_of

from psdr_jit import Parameter, Pose, Profile, Vertices
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse.variables import like, numbers, rigid
from psdr_jit.scene import io as scene_io


def begin(variable, scene):
    return variable.begin(scene, mi.traverse(scene))


@pytest.mark.parametrize("turn", [(0, 0, 0), (1e-4, 0, 0), (0.3, -0.2, 0.9), (0, 2.5, 0)])
def test_rigid_is_a_rotation_and_its_derivative_is_right(llvm, turn):
    θ, x = np.array(turn, float), np.array([0.3, -0.7, 0.5])
    matrix = np.array(rigid(mi.Vector3f(0), mi.Vector3f(*turn)).matrix).reshape(4, 4)[:3, :3]
    angle = np.linalg.norm(θ)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-5) and np.linalg.det(matrix) == pytest.approx(1, abs=1e-5)
    assert np.trace(matrix) == pytest.approx(1 + 2 * np.cos(angle), abs=1e-5)
    assert np.allclose(matrix @ θ, θ, atol=1e-5)
    latent = mi.Vector3f(*turn)
    dr.enable_grad(latent)
    dr.backward(dr.dot(rigid(mi.Vector3f(0), latent) @ mi.Point3f(*x.tolist()), mi.Vector3f(1, 2, 3)))

    def value(t):
        axis = t / max(np.linalg.norm(t), 1e-300)
        c, s = np.cos(np.linalg.norm(t)), np.sin(np.linalg.norm(t))
        return (c * x + s * np.cross(axis, x) + (1 - c) * axis * (axis @ x)) @ [1, 2, 3]

    expected = [(value(θ + h) - value(θ - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
    assert np.allclose(np.array(dr.grad(latent)).ravel(), expected, atol=2e-3)


@pytest.mark.parametrize("value", ["Color3f", "Point3f", "Float", "TensorXf"])
def test_numbers_and_back(llvm, value):
    made = {
        "Color3f": lambda: mi.Color3f(0.1, 0.2, 0.3),
        "Point3f": lambda: mi.Point3f([1, 2], [3, 4], [5, 6]),
        "Float": lambda: mi.Float(1, 2, 3),
        "TensorXf": lambda: mi.TensorXf(np.arange(6.0).reshape(2, 3)),
    }[value]()
    flat = numbers(made)
    again = like(made, 2 * flat)
    assert type(again) is type(made) and np.allclose(np.array(again), 2 * np.array(made))
    assert dr.shape(again) == dr.shape(made)
    if value == "Point3f":
        assert flat.tolist() == [1, 3, 5, 2, 4, 6]  # point by point


def test_pose_moves_about_the_centre_and_comes_back(llvm):
    scene = scene_of()
    pose = Pose(BOX, 0.1, turn_rate=1, turn_axes="xyz", start_shift=(0.5, 0, 0), start_turn=(0, 90, 0))
    latents = begin(pose, scene)
    own = numbers(mi.traverse(scene)[BOX]).reshape(-1, 3)
    assert np.allclose(numbers(pose.value(latents)).reshape(-1, 3), own, atol=1e-6)
    moved = numbers(pose.value(pose.start(latents, None))).reshape(-1, 3)
    centre = (own.max(0) + own.min(0)) / 2
    arm = own - centre
    assert np.allclose(moved, centre + [0.5, 0, 0] + arm @ [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-5)
    assert pose.offset(pose.start(latents, None)) == pytest.approx({"distance": 0.5, "angle_degrees": 90}, rel=1e-4)


def test_pose_of_a_camera_is_in_its_own_frame(llvm):
    scene = scene_of()
    pose = Pose("camera.to_world", 0.1, turn_rate=1, turn_axes="xyz", start_shift=(0, 0, 1))
    before = np.array(mi.traverse(scene)["camera.to_world"].matrix).reshape(4, 4)
    latents = pose.start(begin(pose, scene), None)
    after = np.array(pose.value(latents).matrix).reshape(4, 4)
    assert np.allclose(after[:3, 3], before[:3, 3] + before[:3, 2], atol=1e-5)  # forward


def test_a_camera_turns_about_its_pivot(llvm):
    scene = scene_of()
    pivot = np.array([0.0, -0.5, 0.0])
    pose = Pose("camera.to_world", 0.1, turn_rate=1, turn_axes="y", start_turn=(0, 90, 0), pivot=pivot)
    before = np.array(mi.traverse(scene)["camera.to_world"].matrix).reshape(4, 4)[:3, 3]
    latents = pose.start(begin(pose, scene), None)
    after = np.array(pose.value(latents).matrix).reshape(4, 4)[:3, 3]
    arm = before - pivot
    assert np.allclose(after, pivot + [arm[2], arm[1], -arm[0]], atol=1e-5)
    moved = {"distance": np.linalg.norm(after - before), "angle_degrees": 90}
    assert pose.offset(latents) == pytest.approx(moved, rel=1e-4)


def test_axes_that_may_not_move_do_not(llvm):
    scene = scene_of()
    pose = Pose(BOX, 0.1, shift_axes="xz", spread_shift=0.3)
    latents = pose.start(begin(pose, scene), np.random.default_rng(1))
    shift = np.array(latents["shift"]).ravel()
    assert shift[1] == 0 and shift[0] != 0 and shift[2] != 0
    dr.enable_grad(latents["shift"])
    dr.backward(dr.sum(pose.value(latents)))
    assert np.array(dr.grad(latents["shift"])).ravel()[1] == 0
    with pytest.raises(OptionError, match="never come back"):
        turned = Pose(BOX, 0.1, start_turn=(0, 30, 0))
        turned.start(begin(turned, scene), None)
    with pytest.raises(OptionError, match="never come back"):
        stuck = Pose(BOX, 0.1, shift_axes="x", start_shift=(0, 1, 0))
        stuck.start(begin(stuck, scene), None)


def test_parameters_are_clamped_and_start_where_asked(llvm):
    scene = scene_of()
    variable = Parameter("blocker.bsdf.reflectance.value", 0.1, lower=0, upper=1, start_at=(0.5, 1, 0))
    latents = begin(variable, scene)
    assert np.array(variable.start(latents, None)["value"]).ravel().tolist() == [0.5, 1, 0]
    beyond = like(latents["value"], [0.5, 2, -1])
    assert np.array(variable.constrained({"value": beyond})["value"]).ravel().tolist() == [0.5, 1, 0]
    with pytest.raises(OptionError, match="outside of its range from 0 to 1"):
        outside = Parameter("blocker.bsdf.reflectance.value", 0.1, lower=0, upper=1, start_at=(0.5, 2, -1))
        outside.start(begin(outside, scene), None)
    with pytest.raises(ParameterError, match="one number or 3"):
        wrong = Parameter("blocker.bsdf.reflectance.value", 0.1, start_at=(1, 2))
        wrong.start(begin(wrong, scene), None)
    with pytest.raises(OptionError, match="above upper"):
        begin(Parameter("blocker.bsdf.reflectance.value", 0.1, lower=1, upper=0), scene)
    with pytest.raises(ParameterError, match='kind "pose"'):
        begin(Parameter("camera.to_world", 0.1), scene)


def test_profile_moves_columns_outward(llvm):
    scene = scene_io.load_scene(scene_io.shipped_scene("inverse/profile.xml"), res=8)
    variable = Profile("prism.vertex_positions", 0.1)
    latents = begin(variable, scene)
    assert dr.width(latents["displacement"]) == 100
    own = numbers(mi.traverse(scene)["prism.vertex_positions"]).reshape(-1, 3)
    moved = numbers(variable.value({"displacement": mi.Float([0.1] * 100)})).reshape(-1, 3)
    step = moved - own
    assert np.allclose(np.linalg.norm(step[:200], axis=1), 0.1, atol=1e-5) and np.allclose(step[200:], 0)
    assert np.all(step[:, 1] == 0) and np.all(np.einsum("nd,nd->n", step[:200], own[:200] * [1, 0, 1]) > 0)
    round_start = Profile("prism.vertex_positions", 0.1, start_at="round")
    ring = numbers(round_start.value(round_start.start(begin(round_start, scene), None))).reshape(-1, 3)[:200, [0, 2]]
    radius = np.linalg.norm(ring - (own[:200, [0, 2]].max(0) + own[:200, [0, 2]].min(0)) / 2, axis=1)
    assert np.ptp(radius) < 1e-5


def test_vertices_return_to_the_mesh(llvm):
    scene = scene_io.load_scene(scene_io.shipped_scene("inverse/eight_views.xml"), res=8)
    for smoothness in (0.0, 10.0):
        variable = Vertices("body.vertex_positions", 0.1, smoothness=smoothness, spread=0.1)
        latents = begin(variable, scene)
        assert variable.offset(latents)["rms"] < 1e-5
        assert 0.005 < variable.offset(variable.start(latents, np.random.default_rng(2)))["rms"] < 0.2
    with pytest.raises(ParameterError, match="vertex_positions"):
        begin(Vertices("view0.to_world", 0.1), scene)


@pytest.mark.parametrize("smoothness", [0.0, 10.0])
def test_a_height_field_moves_along_one_axis(llvm, smoothness):
    """Whatever the latent says: the gradient of the other coordinates is 0, and so is a perturbed start's change."""
    scene = scene_io.load_scene(scene_io.shipped_scene("inverse/lens.xml"), res=8)
    variable = Vertices("lens.vertex_positions", 0.1, smoothness, axes="y", spread=0.1, spread_bumps=0.02)
    latents = begin(variable, scene)
    own = numbers(mi.traverse(scene)["lens.vertex_positions"]).reshape(-1, 3)
    moved = numbers(variable.value({"u": latents["u"] + 0.01})).reshape(-1, 3)
    assert np.array_equal(moved[:, [0, 2]], own[:, [0, 2]]) and np.all(moved[:, 1] > own[:, 1])
    start = numbers(variable.value(variable.start(latents, np.random.default_rng(2)))).reshape(-1, 3)
    assert np.array_equal(start[:, [0, 2]], own[:, [0, 2]]) and np.std(start[:, 1]) == pytest.approx(0.02, rel=0.2)
    u = mi.Float(latents["u"])
    dr.enable_grad(u)
    dr.backward(dr.sum(dr.square(variable.value({"u": u}) + 1)))
    slope = numbers(dr.grad(u)).reshape(-1, 3)
    assert np.abs(slope[:, [0, 2]]).max() < 1e-6 < np.abs(slope[:, 1]).min()


@pytest.mark.parametrize("axes", ["", "yy", "yw"])
def test_axes_of_vertices(llvm, axes):
    with pytest.raises(OptionError, match="expected letters out of xyz"):
        begin(Vertices("lens.vertex_positions", 0.1, axes=axes), scene_io.load_scene(
            scene_io.shipped_scene("inverse/lens.xml"), res=8))  # fmt: skip
