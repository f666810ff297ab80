"""Guides of lines through edges: made from earlier calls alone, kept, the same in both modes, and never a bias."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity

from psdr_jit.core.line_guide import LineGuide, LineTally, evenly
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.scene import io as scene_io

BLOCKER = "blocker.vertex_positions"
SPEC = {"type": "psdr_path", "max_depth": 3}


def scene_of(name: str, res: int = 16) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), res=res)


def rendered(motion, integrator, seed: int, spp: int = 8) -> np.ndarray:
    motion.attach()
    return np.array(integrator.render_forward(motion.scene, motion.params, seed=seed, spp=spp))


def lines_of(integrator) -> dict[str, LineGuide | None]:
    return {t.name: t.lines for t in integrator.plan.running}


def prefers(integrator) -> list[bool]:
    return [lines.prefers for lines in lines_of(integrator).values() if lines is not None]


def test_they_change_at_powers_of_four_and_in_between_not(llvm):
    motion, integrator = perturb(scene_of("baffled_light"), BLOCKER, (1, 0, 0)), integrator_specs.build(SPEC)
    seen = []
    for seed in range(6):
        rendered(motion, integrator, seed)
        seen.append(lines_of(integrator))
    motion.restore()
    assert any(prefers(integrator))
    assert seen[0] == seen[1] == seen[2] == seen[3] != seen[4] == seen[5]


@pytest.mark.parametrize("guide", ["off", "on"])
def test_they_can_be_switched(llvm, guide):
    motion = perturb(scene_of("area_shadow"), BLOCKER, (1, 0, 0))
    integrator = integrator_specs.build({**SPEC, "max_depth": 2, "guide": guide})
    for seed in range(5):
        rendered(motion, integrator, seed)
        assert all((lines is not None) == (guide == "on") for name, lines in lines_of(integrator).items()
                   if name != "interior")  # fmt: skip
    motion.restore()
    with pytest.raises(RuntimeError, match="guide = 'maybe': use auto, on or off"):
        mi.load_dict({"type": "psdr_path", "guide": "maybe"})


def test_both_modes_draw_the_same_lines_after_learning(llvm):
    scene = scene_of("baffled_light")
    motion, integrator = perturb(scene, BLOCKER, (1, 0, 0)), integrator_specs.build(SPEC)
    for seed in range(5):
        rendered(motion, integrator, seed)
    motion.restore()
    wJv, JTwv, w, Jv = adjoint_identity(scene, BLOCKER, integrator, spp=8)
    assert any(prefers(integrator))
    assert abs(wJv - JTwv) <= 1e-5 * w * Jv


def test_backward_calls_tell_as_well(llvm):
    """What is heard in backward mode counts the pixels that the loss looks at, and no others."""
    scene = scene_of("area_shadow")
    integrator = integrator_specs.build({**SPEC, "max_depth": 2})
    params = mi.traverse(scene)
    heard = []
    for side in (slice(0, 8), slice(8, 16)):
        grad = np.zeros((16, 16, 3), np.float32)
        grad[:, side] = 1
        value = type(params[BLOCKER])(params[BLOCKER])
        dr.enable_grad(value)
        params[BLOCKER] = value
        params.update()
        ready = prepare(integrator.call(scene, scene.sensors()[0], 3, 16, "backward"))
        tallies = {}
        for term, job in ready.jobs:
            tallies[term.name] = LineTally() if job.tally is not None else None
            term.backward(replace(job, tally=tallies[term.name]), mi.TensorXf(grad))
        heard.append(tallies["direct"].sums()[0][0])
    left, right = (h.sum((0, 2, 3)) for h in heard)
    assert left.sum() > 0 and right.sum() > 0
    shared = np.minimum(left / left.sum(), right / right.sum()).sum()
    assert shared < 0.7


def made_for_something_else() -> LineGuide:
    """A guide towards a corner of the cube where nothing in particular is to be found."""
    n = 200_000
    x, u, v = np.random.default_rng(1).random((3, n))
    drawn = evenly(mi.Float64(x), mi.Point2f(u.astype(np.float32), v.astype(np.float32)))
    worth = dr.select((drawn.x < 0.3) & (drawn.u.x > 0.6), mi.Float(1), 0.03)
    tally = LineTally()
    tally.add(drawn, dr.arange(mi.UInt32, n), worth, 1)
    guide, gain = tally.guide()
    assert gain > 2
    return guide


def mean_and_error(name: str, guide: LineGuide | None, seeds: int):
    """Mean image and standard error with the plan's guides replaced by one; None: without."""
    motion = perturb(scene_of(name, 8), BLOCKER, (1, 0, 0))
    motion.attach()
    integrator = integrator_specs.build(SPEC)
    plan = prepare(integrator.call(motion.scene, motion.scene.sensors()[0], 0, 32)).plan
    terms = tuple(replace(t, lines=guide if t.name != "interior" and t.runs else None) for t in plan.terms)
    given = integrator_specs.build({**SPEC, "plan": replace(plan, terms=terms).to_json()})
    images = np.stack([rendered(motion, given, seed, 32) for seed in range(1, seeds + 1)])
    motion.restore()
    return images.mean(0), images.std(0, ddof=1) / np.sqrt(seeds)


def slowly(name: str):
    return pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", ["area_shadow", slowly("baffled_light"), slowly("environment_shadow")])
def test_a_guide_for_something_else_is_no_bias(llvm, name):
    """Only noise may tell: 0, -g and g/2 would be rejected."""
    seeds = 12
    (a, δa), (b, δb) = (mean_and_error(name, guide, seeds) for guide in (None, made_for_something_else()))
    blocks_a, blocks_b = (x.reshape(4, 2, 4, 2, 3).mean((1, 3, 4)) for x in (a, b))
    error = np.sqrt((δa**2 + δb**2).reshape(4, 2, 4, 2, 3).sum((1, 3, 4))) / 12
    seen = np.abs(blocks_a) > 1e-3 * np.abs(blocks_a).max()
    z = ((blocks_b - blocks_a) / np.maximum(error, 1e-12))[seen]
    assert np.sqrt(np.mean(z**2)) < 2 and np.abs(z).max() < 5
    for wrong in (0 * blocks_a, -blocks_a, 0.5 * blocks_a):
        assert np.abs((blocks_b - wrong) / np.maximum(error, 1e-12))[seen].max() > 5
