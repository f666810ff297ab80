"""What the plan says for every kind of scene and parameter, and that the integrator does it."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import OptionError, ParameterError, ZeroDerivativeWarning
from psdr_jit.scene import io as scene_io

ALL = {"interior", "primary", "direct", "indirect"}  # that a scene without mirrors and glass can need
SEEDS = 8


def scene_of(name: str, **defaults) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), **{"res": 16, **defaults})


def plan_of(name: str, *params: str, depth: int = 4, spp: int = 16, load: dict | None = None, **options):
    integrator = {"type": "psdr_path", "max_depth": depth, **options}
    return psdr_jit.make_plan(scene_of(name, **(load or {})), params, integrator=integrator, spp=spp)


CASES = {  # (scene, parameter, depth): terms that run
    ("cbox", "small-box.vertex_positions", 4): ALL,
    ("cbox", "small-box.vertex_positions", 2): {"interior", "primary", "direct"},
    ("cbox", "small-box.vertex_positions", 1): {"primary"},
    ("cbox", "small-box.vertex_positions", 0): set(),
    ("cbox", "white.reflectance.value", 4): {"interior"},
    ("cbox", "white.reflectance.value", 1): set(),
    ("textured_emitter", "card.emitter.radiance.data", 1): {"interior"},
    ("textured_emitter", "card.vertex_positions", 1): {"interior", "primary"},
    ("sliding_texture", "floor.bsdf.reflectance.data", 4): {"interior"},
    ("point_shadow", "lamp.position", 4): {"interior", "direct"},
    ("area_shadow", "camera.to_world", 4): ALL,
    ("area_shadow", "light.to_world", 2): {"interior", "direct"},  # the light is out of the picture
    ("baffled_light", "blocker.vertex_positions", 4): {"interior", "primary", "indirect"},  # no light sees an outline
    ("envmap_rotation", "ball.to_world", 4): {"interior", "primary"},  # one convex body
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_terms(llvm, case):
    name, param, depth = case
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ZeroDerivativeWarning)
        plan = plan_of(name, param, depth=depth)
    assert {t.name for t in plan.running} == CASES[case]
    for term in plan.terms:
        assert term.reason and (term.spp > 0) == term.runs and bool(term.streams) == term.runs
        assert term.name in str(plan) and term.reason in str(plan)


def test_reasons(llvm):
    assert "one dimension less" in plan_of("point_shadow", "blocker.vertex_positions").term("direct").reason
    assert "alone and convex" in plan_of("envmap_rotation", "ball.to_world").term("direct").reason
    assert "switched off" in plan_of("cbox", "small-box.vertex_positions", sppp=0, spp=0).term("primary").reason


def test_edges_are_counted(llvm):
    edges = plan_of("cbox", "small-box.vertex_positions").term("primary").edges
    assert edges.sampled == 9 and edges.total > 60  # a box shows three faces of six


def test_plans_compare_as_data(llvm):
    assert plan_of("cbox", "small-box.vertex_positions") == plan_of("cbox", "small-box.vertex_positions")
    assert plan_of("cbox", "small-box.vertex_positions") != plan_of("cbox", "small-box.vertex_positions", spp=8)


def test_asking_leaves_the_scene_as_it_was(llvm):
    scene = scene_of("envmap_rotation")
    psdr_jit.make_plan(scene, ["ball.to_world"])
    with pytest.warns(ZeroDerivativeWarning):
        assert not psdr_jit.make_plan(scene).running
    with pytest.raises(ParameterError, match="no parameter 'sphere'"):
        psdr_jit.make_plan(scene, ["sphere"])
    with pytest.raises(OptionError, match="psdr_path"):
        psdr_jit.make_plan(scene, integrator="prb")


def test_the_integrator_executes_the_plan(llvm):
    scene = scene_of("cbox")
    motion = perturb(scene, "small-box.vertex_positions", (1, 0, 0))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3})
    motion.attach()
    integrator.render_forward(scene, motion.params, spp=4)
    told = psdr_jit.make_plan(scene, ["small-box.vertex_positions"], integrator={"type": "psdr_path", "max_depth": 3},
                              spp=4)  # fmt: skip
    assert [(t.name, t.runs, t.spp, t.reason) for t in integrator.plan.terms] == [
        (t.name, t.runs, t.spp, t.reason) for t in told.terms
    ]
    motion.restore()


def test_nothing_enabled_is_zero_at_once_and_said(llvm):
    scene = scene_of("cbox")
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4})
    with pytest.warns(ZeroDerivativeWarning, match="dr.enable_grad"):
        image = integrator.render_forward(scene, mi.traverse(scene), spp=4)
    assert not np.array(image).any() and image.shape == (16, 16, 3)


PRUNED = {  # scenes of which the planner leaves out something, and what moves
    "material": ("cbox", "white.reflectance.value", {}, 3),
    "radiance": ("textured_emitter", "card.emitter.radiance.data", {}, 2),
    "convex": ("envmap_rotation", "ball.to_world", {"direction": (1, 0, 0)}, 3),
    "hidden": ("baffled_light", "blocker.vertex_positions", {"direction": (1, 0, 0)}, 3),
    "lamp": ("point_shadow", "lamp.position", {"direction": (1, 0, 0)}, 3),
    "box": ("cbox", "small-box.vertex_positions", {"direction": (1, 0, 0)}, 3),
}


SLOW = ("hidden", "convex", "lamp", "box", "material", "radiance")  # many kernels: every term with and without a plan


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in PRUNED])
def test_the_planner_changes_nothing_but_time(llvm, case):
    """Means of independent seeds with and without it agree within their errors."""
    name, param, how, depth = PRUNED[case]
    scene = scene_of(name)
    motion = perturb(scene, param, **how)
    means = []
    for plan in ("lean", "full"):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": depth, "plan": plan})
        images = []
        for seed in range(24):
            motion.attach()
            images.append(np.array(integrator.render_forward(scene, motion.params, seed=seed, spp=16)))
        means.append(np.array(images, float).reshape(24, 4, 4, 4, 4, -1).mean((2, 4)))  # blocks of 4 x 4 pixels
    motion.restore()
    lean, full = means
    error = np.sqrt((lean.var(0, ddof=1) + full.var(0, ddof=1)) / 24)
    z = (lean.mean(0) - full.mean(0)) / np.maximum(error, 1e-7 + 1e-5 * np.abs(full).max())
    assert np.abs(z).max() < 6
    assert np.abs(full.mean(0)).max() > 5 * error.mean()  # zero would be rejected


def test_full_plan_in_backward_mode(llvm):
    scene = scene_of("cbox")
    params = mi.traverse(scene)
    value = type(params["white.reflectance.value"])(params["white.reflectance.value"])
    dr.enable_grad(value)
    params["white.reflectance.value"] = value
    params.update()
    grads = []
    for plan in ("lean", "full"):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "plan": plan})
        dr.set_grad(value, 0)
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), spp=64)
        grads.append(np.array(dr.grad(value)).ravel())
    assert np.allclose(*grads, rtol=0.05) and grads[0].min() > 0


# ------------------------------------------------------------------------------------------ a known direction


def known(**options):
    return integrator_specs.build({"type": "psdr_path", "max_depth": 3, "direction": "known", **options})


def rigidly(scene: mi.Scene, names: list[str]):
    """All poses turned and shifted by one θ, whose tangent is set."""
    params, θ = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(θ)
    motion = mi.Transform4f().translate(mi.Vector3f(θ, 2 * θ, 0)).rotate(mi.Vector3f(0, 0.6, 0.8), 40 * θ)
    for name in names:
        value = params[name]
        if "Transform" in type(value).__name__:
            params[name] = motion @ value
        elif name.endswith("position"):
            params[name] = motion @ mi.Point3f(value)
        else:
            points = dr.gather(mi.Point3f, value, dr.arange(mi.UInt32, dr.width(value) // 3))
            params[name] = dr.ravel(motion @ points)
        params.set_dirty(name)
    params.update()
    dr.forward(θ, dr.ADFlag.ClearEdges)
    return params


def test_everything_together_is_nothing(llvm):
    scene = scene_of("point_shadow")
    every = [n for n in mi.traverse(scene).keys() if n.endswith(("vertex_positions", "to_world", "position"))
             and ".film" not in n]  # fmt: skip
    integrator = known()
    with pytest.warns(ZeroDerivativeWarning, match="one rigid body"):
        image = integrator.render_forward(scene, rigidly(scene, every), spp=4)
    assert not integrator.plan.running and not np.array(image).any()
    scene = scene_of("point_shadow")
    integrator.render_forward(scene, rigidly(scene, every[:-1]), spp=4)  # all but one: not nothing
    assert integrator.plan.running


def test_only_what_has_a_velocity_moves(llvm):
    """One corner of a box out of many: the derivative is that of any direction, with fewer edges."""
    scene = scene_of("many_occluders")
    name = "occluders.vertex_positions"
    motion = perturb(scene, name, index=1)
    images = {}
    for direction in ("any", "known"):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "direction": direction})
        found = []
        for seed in range(SEEDS):
            motion.attach()
            found.append(np.array(integrator.render_forward(scene, motion.params, seed=seed, spp=128), dtype=float))
        images[direction] = np.array(found)
    motion.restore()
    a, b = images["any"], images["known"]
    error = np.sqrt((a.mean((1, 2, 3)).var(ddof=1) + b.mean((1, 2, 3)).var(ddof=1)) / SEEDS)
    assert abs(a.mean() - b.mean()) < 5 * error
    assert b.var(0).mean() < a.var(0).mean() / 10


def test_backward_mode_has_no_direction(llvm):
    scene = scene_of("cbox")
    with pytest.raises(OptionError, match='direction="any"'):
        known().render_backward(scene, mi.traverse(scene), dr.ones(mi.TensorXf, (16, 16, 3)), spp=1)


def test_terms_follow_the_scene_as_it_is(llvm):
    """A lone convex body has no shadow on itself until it is dented: then at once, whatever was learned before."""
    scene = scene_of("icosphere")
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4})
    params = mi.traverse(scene)
    original = np.array(params["ball.vertex_positions"])

    def running(points: np.ndarray) -> set[str]:
        params["ball.vertex_positions"] = mi.Float(points)
        params.update()
        dr.enable_grad(params["ball.vertex_positions"])
        params.update()
        integrator.render_forward(scene, params, seed=1, spp=2)
        return {t.name for t in integrator.plan.running}

    for _ in range(3):  # the third call is none at which budgets are reconsidered
        assert running(original) == {"interior", "primary"}
    dented = original.reshape(-1, 3).copy()
    dented[0] *= 0.2
    assert running(dented.ravel()) == ALL


def test_a_moving_camera_sees_all_of_the_background(llvm):
    """In material form only first vertices slide, but what lies behind an edge is seen with all of its light."""
    scene = scene_of("cbox", res=8)
    motion = perturb(scene, "sensor.to_world", (1, 0, 0))
    means, errors = [], []
    for plan in ("lean", "full"):
        spec = {"type": "psdr_path", "max_depth": 6, "rr_depth": 50, "form": "material", "plan": plan}
        integrator = integrator_specs.build({**spec, "sppc": 0, "sppp": 0, "sppd": 0, "sppi": 64})
        images = []
        for seed in range(16):
            motion.attach()
            images.append(np.array(integrator.render_forward(scene, motion.params, seed=seed)))
        means.append(np.mean(images, (0, 3)))
        errors.append(np.std(np.mean(images, 3), 0, ddof=1) / 4)
    motion.restore()
    z = (means[0] - means[1]) / np.hypot(*errors)
    scale = np.sum(means[0] * means[1]) / np.sum(means[1] ** 2)
    assert np.abs(z).max() < 6 and abs(scale - 1) < 0.05
