"""A plan as text, and as input: several processes that are given one plan draw the same samples."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import OptionError
from psdr_jit.plan.plan import Plan
from psdr_jit.scene import io as scene_io

BOX = "small-box.vertex_positions"
SPEC = {"type": "psdr_path", "max_depth": 4}


@pytest.fixture
def scene(llvm) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)


def derivative(scene: mi.Scene, integrator, spp: int = 4) -> np.ndarray:
    motion = perturb(scene, BOX, (1, 0, 0))
    motion.attach()
    image = np.array(integrator.render_forward(scene, motion.params, seed=2, spp=spp))
    motion.restore()
    return image


def test_text_and_back(scene):
    plan = psdr_jit.make_plan(scene, [BOX], integrator=SPEC, spp=4)
    assert Plan.from_json(plan.to_json()) == plan
    assert Plan.from_json(json.dumps(json.loads(plan.to_json()), indent=2)) == plan


def test_it_is_executed_as_it_is(scene):
    """The integrator that made the plan by a pilot, and another one that is given it, render the same image."""
    first = integrator_specs.build(SPEC)
    expected = derivative(scene, first)
    given = mi.load_dict({**SPEC, "plan": first.plan.to_json()})
    image = derivative(scene, given, spp=99)  # the plan's own samples count
    assert np.allclose(image, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    assert given.plan == first.plan


def test_tools_take_it_and_switch_terms_off(scene):
    plan = psdr_jit.make_plan(scene, [BOX], integrator={**SPEC, "form": "material"}, spp=2)
    result = psdr_jit.gradient(scene, BOX, (1, 0, 0), integrator={**SPEC, "plan": plan}, spp=2, seeds=2)
    alone = integrator_specs.build_term({**SPEC, "plan": plan}, "direct")
    derivative(scene, alone)
    assert [t.name for t in alone.plan.running] == ["direct"] and alone.plan.form == "material"
    assert np.allclose(sum(result.terms.values()), result.total, atol=1e-6)


@pytest.mark.parametrize("text, message", [
    ("{", "not a plan"), ('{"form": "spatial"}', "not a plan"), ("lazy", "use lean or full"),
])  # fmt: skip
def test_what_is_no_plan_is_an_error(scene, text, message):
    with pytest.raises(OptionError, match=message):
        derivative(scene, integrator_specs.build({**SPEC, "plan": text}))


def test_plans_of_other_terms_and_forms_are_errors(scene):
    data = json.loads(psdr_jit.make_plan(scene, [BOX], integrator=SPEC, spp=4).to_json())
    with pytest.raises(OptionError, match="make it anew"):
        derivative(scene, integrator_specs.build({**SPEC, "plan": json.dumps({**data, "terms": data["terms"][:2]})}))
    with pytest.raises(OptionError, match="spatial or material"):
        derivative(scene, integrator_specs.build({**SPEC, "plan": json.dumps({**data, "form": "liquid"})}))


def test_a_plan_without_edges_is_for_its_own_scene(llvm, scene):
    """Where no light sees an outline, *direct* is left out; elsewhere that would be a silent 0."""
    baffled = scene_io.load_scene(scene_io.shipped_scene("baffled_light.xml"), res=8)
    spec = {**SPEC, "max_depth": 2}
    plan = psdr_jit.make_plan(baffled, ["blocker.vertex_positions"], integrator=spec, spp=2)
    assert not plan.term("direct").runs
    psdr_jit.gradient(baffled, "blocker.vertex_positions", (1, 0, 0), integrator={**spec, "plan": plan}, seeds=1)
    with pytest.raises(OptionError, match="leaves out direct"):
        psdr_jit.gradient(scene, BOX, (1, 0, 0), integrator={**spec, "plan": plan}, seeds=1)
