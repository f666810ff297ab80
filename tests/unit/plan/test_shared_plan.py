"""A plan that was made before, given to an integrator as `plan=`: a `Plan`, or its text."""

from __future__ import annotations

from html import escape

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.errors import OptionError
from psdr_jit.scene import io as scene_io

BOX = "blocker.vertex_positions"
MOVE = (1, 0, 0)


@pytest.fixture
def scene(llvm) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=16)


@pytest.fixture
def plan(scene) -> psdr_jit.Plan:
    return psdr_jit.make_plan(scene, BOX, spp=16)


def test_text_and_back(plan):
    assert psdr_jit.Plan.from_json(plan.to_json()) == plan


def test_gradient_takes_a_plan_and_renders_each_term_once(scene, plan):
    """Terms are rendered by integrators of one term each, which share the plan: none may run all of it."""
    free = psdr_jit.gradient(scene, BOX, MOVE, spp=16, seeds=4)
    given = psdr_jit.gradient(scene, BOX, MOVE, seeds=4, integrator={"type": "psdr_path", "plan": plan})
    assert np.sum(free.total * given.total) / np.sum(free.total**2) == pytest.approx(1, abs=0.02)
    assert set(given.terms) == {"interior", "primary", "chain", "direct", "indirect"}
    for name, image in given.terms.items():
        assert image.any() == plan.term(name).runs
    assert not np.allclose(given.terms["primary"], given.terms["direct"])


def test_integrators_with_the_same_plan_agree(scene, plan):
    images = []
    for _ in range(2):
        integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2, "plan": plan.to_json()})
        result = psdr_jit.gradient(scene, BOX, MOVE, integrator=integrator, spp=8, seeds=1)
        images.append(result.total)
        assert [(t.name, t.runs, t.spp) for t in integrator.plan.terms] == [
            (t.name, t.runs, t.spp) for t in plan.terms
        ], "samples are those of the plan, whatever the call says"
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6 * np.abs(images[0]).max())


def test_a_budget_of_0_switches_a_term_of_the_plan_off(scene, plan):
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppp": 0, "plan": plan.to_json()})
    psdr_jit.gradient(scene, BOX, MOVE, integrator=integrator, seeds=1)
    assert not integrator.plan.term("primary").runs and "budget" in integrator.plan.term("primary").reason
    assert integrator.plan.term("direct") == plan.term("direct")


def test_scene_files_take_its_text(llvm, plan):
    value = escape(plan.to_json())
    text = f'<integrator version="3.0.0" type="psdr_path"><string name="plan" value="{value}"/></integrator>'
    assert psdr_jit.Plan.from_json(mi.load_string(text).options.plan) == plan


@pytest.mark.parametrize("text", ["{", "{}", '{"terms": []}'])
def test_other_texts_are_refused(scene, text):
    with pytest.raises(OptionError, match="not a plan"):
        psdr_jit.gradient(scene, BOX, MOVE, seeds=1, integrator={"type": "psdr_path", "plan": text})
