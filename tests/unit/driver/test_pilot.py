"""Budgets and forms that follow from measured noise: the optimisation, the probe, what is learned from calls."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver import pilot
from psdr_jit.driver.noise_log import NoiseLog
from psdr_jit.driver.pilot import Measurement, TermNoise
from psdr_jit.driver.prepare import prepare
from psdr_jit.driver.terms import TERMS
from psdr_jit.options import Options
from psdr_jit.plan.form_choice import forms_to_try
from psdr_jit.plan.plan import Geometry
from psdr_jit.plan.probe_motion import probe_motion
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.params import also_enabled

BOX = "small-box.vertex_positions"


def scene_of(name: str, **defaults) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), **{"res": 16, **defaults})


def noise(**terms: tuple[float, float, float]) -> Measurement:
    """Of the spatial form; (variance at `pilot.MORE` paths, p, cost) by term."""
    return Measurement({"spatial": {name: TermNoise(*t, even_cost=t[2]) for name, t in terms.items()}})


# ------------------------------------------------------------------------------------------ the optimisation


def test_independent_samples_follow_the_square_root_rule():
    """n ∝ √(V/C) for p = 1, and the cost of equal budgets is kept."""
    measured = noise(interior=(1.0, 1.0, 1.0), primary=(4.0, 1.0, 1.0), direct=(1.0, 1.0, 4.0))
    spp = {"interior": 60, "primary": 60, "direct": 60}
    n = measured.allocate("spatial", spp, spp)
    assert n["primary"] == pytest.approx(2 * n["interior"], rel=0.05)
    assert n["direct"] == pytest.approx(n["interior"] / 2, rel=0.05)
    assert n["interior"] + n["primary"] + 4 * n["direct"] == pytest.approx(6 * 60, rel=0.03)


@pytest.mark.parametrize("p", [1.0, 1.7, 3.0])
def test_nothing_nearby_is_better(p):
    measured = noise(interior=(3.0, 1.0, 1.0), primary=(0.5, p, 1.2), direct=(9.0, 1.3, 2.5))
    spp = dict.fromkeys(("interior", "primary", "direct"), 400)
    best = measured.allocate("spatial", spp, spp)
    least = measured.efficiency("spatial", best)
    assert least < measured.efficiency("spatial", spp)
    rng = np.random.default_rng(1)
    for _ in range(200):
        other = {name: n * np.exp(rng.normal() * 0.3) for name, n in best.items()}
        scale = sum(measured.noise["spatial"][k].cost * best[k] for k in best) / sum(
            measured.noise["spatial"][k].cost * other[k] for k in best
        )
        assert measured.efficiency("spatial", {k: n * scale for k, n in other.items()}) >= 0.995 * least


def test_the_total_is_that_of_samples_spread_evenly():
    """A term whose noisy pixels are costly takes from the others; it does not make the whole dearer."""
    even = noise(chain=(1.0, 1.0, 4.0), interior=(1.0, 1.0, 1.0)).noise["spatial"]
    measured = Measurement({"spatial": {**even, "chain": replace(even["chain"], cost=16.0)}})
    spp = {"chain": 100, "interior": 100}
    n = measured.allocate("spatial", spp, spp)
    assert 16 * n["chain"] + n["interior"] == pytest.approx(5 * 100, rel=0.03)
    assert n["interior"] == pytest.approx(4 * n["chain"], rel=0.06)  # √(V/C)


def both(n: int) -> tuple:
    spp = {"interior": n, "primary": n}
    return "spatial", spp, spp


def test_a_term_that_the_pilot_missed_keeps_a_share():
    n = noise(interior=(1.0, 1.0, 1.0), primary=(0.0, 1.0, 1.0)).allocate(*both(64))
    assert n["primary"] == pilot.LEAST * 64 and n["interior"] > 64
    nothing = noise(interior=(0.0, 1.0, 1.0), primary=(0.0, 1.0, 1.0))
    assert nothing.allocate(*both(5)) == {"interior": 5, "primary": 5}


def test_the_exponent_is_that_of_two_sample_counts():
    term = TermNoise.between(few=1.0, more=pilot.MORE**-2.0, cost=1.0)
    assert term.p == pytest.approx(2) and term.at(2 * pilot.MORE) == pytest.approx(term.at_more / 4)
    assert TermNoise.between(0.0, 1.0, 1.0).p == pilot.SLOWEST
    assert TermNoise.between(1.0, 1e-9, 1.0).p == pilot.FASTEST


# ------------------------------------------------------------------------------------------ the probe's motion


@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("scene_name, param", [
    ("cbox", BOX), ("baffled_light", "blocker.vertex_positions"), ("area_shadow", "light.to_world"),
    ("ball_shadow", "blocker.to_world"), ("area_shadow", "camera.to_world"), ("point_shadow", "lamp.position"),
])  # fmt: skip
def test_the_probe_is_the_derivative_along_its_motion(llvm, form, scene_name, param):
    """Each term's image along the probe is the one that the same shift and turn, set on the parameter itself, give."""
    scene = scene_of(scene_name)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, "form": form, "sppc": 4})
    with also_enabled(scene, [param]):
        prepared = prepare(integrator.call(scene, scene.sensors()[0], 1, 4))
        probe = probe_motion(scene, prepared.jobs[0][1].facts)
        found = {t.name: np.array(t.forward(replace(job, motion=probe))) for t, job in prepared.jobs}
    motion, θ = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(θ)
    value = motion[param]
    centre, shift, turn = ([float(x) for x in np.array(v).ravel()] for v in (probe.centre, probe.shift, probe.turn))
    angle = float(np.linalg.norm(turn))

    def moved(x):
        rotation = mi.Transform4f().translate(mi.Vector3f(shift) * θ).translate(mi.Vector3f(centre)).rotate(
            mi.Vector3f(turn) / angle, float(np.rad2deg(angle)) * θ).translate(-mi.Vector3f(centre))  # fmt: skip
        return rotation @ x

    if "Transform" in type(value).__name__:
        motion[param] = moved(type(value)(value))
    elif dr.depth_v(value) == 2:
        motion[param] = mi.Point3f(value) + mi.Vector3f(shift) * θ
    else:
        points = dr.gather(mi.Point3f, value, dr.arange(mi.UInt32, dr.width(value) // 3))
        motion[param] = dr.ravel(moved(points))
    motion.set_dirty(param)
    motion.update()
    dr.forward(θ, dr.ADFlag.ClearEdges)
    prepared = prepare(integrator.call(scene, scene.sensors()[0], 1, 4))
    for moving in prepared.moving:
        moving.take_tangents()
    for term, job in prepared.jobs:
        expected = np.array(term.forward(job))
        scale = np.abs(expected).max()
        assert np.abs(found[term.name] - expected).max() <= 2e-3 * scale + 1e-6, term.name


# ------------------------------------------------------------------------------------------ which form


FORMS = {  # (scene, parameter, depth): forms that come into question
    ("cbox", BOX, 4): ("spatial", "mixed"),  # next to the large box
    ("cbox", "sensor.to_world", 4): ("spatial", "mixed"),  # walls touch, and all is slid over
    ("sunk_ball", "ball.to_world", 4): ("spatial", "mixed", "film-mixed"),
    ("area_shadow", "blocker.vertex_positions", 4): ("spatial", "material"),
    ("area_shadow", "blocker.vertex_positions", 2): ("spatial",),
    ("area_shadow", "camera.to_world", 4): ("spatial", "material"),
    ("baffled_light", "blocker.vertex_positions", 4): ("spatial", "material", "film-material"),  # it has many faces
    ("baffled_light", "blocker.vertex_positions", 2): ("spatial", "film"),
    ("cbox", "white.reflectance.value", 4): ("spatial",),
}


@pytest.mark.parametrize("case", FORMS, ids=lambda case: "-".join(map(str, case)))
def test_structural_rules(llvm, case):
    name, param, depth = case
    scene = scene_of(name)
    with also_enabled(scene, [param]):
        facts, options, unknown = analyse(scene), Options(max_depth=depth), (Geometry(), None, "")
        forms, reason = forms_to_try(scene, facts, options, *unknown)
        assert forms == FORMS[case] and reason
        assert forms_to_try(scene, facts, replace(options, form="material"), *unknown)[0] == ("material",)


# ------------------------------------------------------------------------------------------ in use


def test_automatic_budgets_cost_as_much_as_equal_ones(llvm):
    scene = scene_of("cbox")
    with also_enabled(scene, [BOX]):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4})
        plan = prepare(integrator.call(scene, scene.sensors()[0], 0, 32)).plan
        assert len({t.spp for t in plan.running}) > 1
        cost = {t.name: t.cost(plan.form, False) for t in TERMS if plan.term(t.name).runs}
        assert sum(cost[t.name] * t.spp for t in plan.running) == pytest.approx(32 * sum(cost.values()), rel=0.05)
        for explicit in ({"sppc": 7}, {"plan": "full", "form": "spatial"}):
            integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, **explicit})
            plan = prepare(integrator.call(scene, scene.sensors()[0], 0, 32)).plan
            assert {t.spp for t in plan.running} == {32}


def test_lines_across_mirrors_tell_what_they_trace(llvm):
    """What lines trace is counted by the pixel they begin in, and their noisy pixels are dearer than the mean."""
    scene = scene_of("mirrors")
    with also_enabled(scene, ["mirror.to_world"]):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3})
        ready = prepare(integrator.call(scene, scene.sensors()[0], 0, 8))
    noise = ready.log.current.noise[ready.plan.form]["chain"]
    assert noise.film.effort.shape == (16, 16) and noise.cost > noise.even_cost > 0
    assert noise.film.effort.min() >= 2 and noise.film.effort.max() > 4 * noise.film.effort.min()


def test_forward_and_backward_mode_share_the_plan(variant):
    scene = scene_of("baffled_light")
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3})
    wJv, JTwv, w, Jv = adjoint_identity(scene, "blocker.vertex_positions", integrator, spp=8)
    assert len({t.spp for t in integrator.plan.running}) > 1
    assert abs(wJv - JTwv) <= 1e-5 * w * Jv


def test_single_terms_agree_on_the_form(llvm):
    """Their images are added up: a sum over different forms would be no derivative of anything."""
    scene = scene_of("baffled_light", max_depth=3)
    spec = {"type": "psdr_path", "max_depth": 3}
    with also_enabled(scene, ["blocker.vertex_positions"]):
        whole = prepare(integrator_specs.build(spec).call(scene, scene.sensors()[0], 0, 16)).plan
        for term in ("interior", "primary", "indirect"):
            alone = prepare(integrator_specs.build_term(spec, term).call(scene, scene.sensors()[0], 0, 16)).plan
            assert alone.form == whole.form == "material" and [t.name for t in alone.running] == [term]


def test_budgets_learn_from_images(llvm):
    """Along x nothing inside of the blocker's faces changes: the probe's motion did not know."""
    scene = scene_of("point_shadow")
    motion = perturb(scene, "blocker.vertex_positions", (1, 0, 0))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    interior = []
    for seed in range(9):
        motion.attach()
        integrator.render_forward(scene, motion.params, seed=seed, spp=16)
        interior.append(integrator.plan.term("interior").spp)
    motion.restore()
    assert interior[-1] < interior[0] / 1.5
    assert interior[2] == interior[3] and interior[4] == interior[7]  # they change at powers of two only


def test_equal_seeds_teach_nothing():
    log = NoiseLog()
    log.pilot(noise(interior=(1.0, 1.0, 1.0)))
    for _ in range(3):
        log.observe("spatial", 5, {"interior": 4}, {"interior": None})
        log.calls += 1
    assert not log.pending


def test_every_pair_counts(llvm):
    """What was seen between two changes of the budgets weighs alike, not the last pair alone."""
    log = NoiseLog()
    log.pilot(noise(interior=(1.0, 1.0, 1.0)))
    log.pending = [("spatial", "interior", pilot.MORE, mi.TensorXf([[v]])) for v in (2.0, 4.0, 9.0)]
    log.learn()
    assert log.current.noise["spatial"]["interior"].at_more == pytest.approx(5.0)
    log.pilot(noise(interior=(1.0, 1.0, 1.0)))
    log.pending = [("spatial", "interior", pilot.MORE, mi.TensorXf([[2.0]]))]
    log.learn()
    assert log.current.noise["spatial"]["interior"].at_more == pytest.approx(2.0)
