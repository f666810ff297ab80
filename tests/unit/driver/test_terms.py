"""A term is one record: adding and removing one touches no other file."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.core import film as films
from psdr_jit.core.streams import Stream
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.terms import TERMS, registered
from psdr_jit.errors import OptionError
from psdr_jit.plan.term import Term
from psdr_jit.scene import io as scene_io

BOX = "small-box.vertex_positions"
VALUE = 0.25  # of every pixel of the dummy's derivative image


def dummy(**changes) -> Term:
    """A term whose derivative is constant, with a budget of its own."""
    told: list[float] = []

    def backward(job, grad_in):
        told.append(float(dr.sum(grad_in, axis=None).array[0]))

    term = Term(
        name="dummy",
        budget="sppx",
        streams=(Stream.CAMERA,),
        needed=lambda facts, options, geometry: (facts.geometry_moves, "for a test"),
        cost=lambda form, sky: 0.5,
        forward=lambda job: films.black(job.film) + VALUE,
        backward=backward,
    )
    backward.told = told
    return dataclasses.replace(term, **changes)


@pytest.fixture
def scene(llvm) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)


def image(scene: mi.Scene, **options) -> np.ndarray:
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "form": "spatial", **options})
    motion = perturb(scene, BOX, (1, 0, 0))
    motion.attach()
    found = np.array(integrator.render_forward(scene, motion.params, seed=1, spp=4))
    motion.restore()
    return found


def test_it_is_planned_summed_and_gone(scene):
    budgets = {"sppc": 4, "sppp": 4, "sppi": 4}
    before = image(scene, **budgets)
    with registered(dummy()):
        assert np.allclose(image(scene, **budgets), before + VALUE, atol=1e-6)
        plan = psdr_jit.make_plan(scene, [BOX])
        assert plan.term("dummy").runs and plan.term("dummy").reason == "for a test" and "dummy" in str(plan)
        assert not psdr_jit.make_plan(scene, ["white.reflectance.value"]).term("dummy").runs
        image(scene)  # budgets by measured noise: the pilot knows it as well
        assert np.allclose(image(scene, **budgets, sppx=0), before, atol=1e-6)
        with pytest.raises(OptionError, match="sppx = -1"):
            image(scene, sppx=-1)
    assert [t.name for t in TERMS] == ["interior", "primary", "chain", "direct", "indirect"]
    assert np.allclose(image(scene, **budgets), before, atol=1e-6)
    with pytest.raises(OptionError, match="sppx"):
        image(scene, sppx=4)


def test_tools_show_it_alone(scene):
    with registered(dummy()):
        spec = {"type": "psdr_path", "max_depth": 2}
        result = psdr_jit.gradient(scene, BOX, (1, 0, 0), integrator=spec, spp=2, seeds=2)
        assert np.allclose(result.terms["dummy"], VALUE) and np.allclose(result.term_stderr["dummy"], 0)


def test_backward_mode_asks_it(scene):
    term = dummy()
    with registered(term):
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "form": "spatial"})
        params = mi.traverse(scene)
        dr.enable_grad(params[BOX])
        params.update()
        integrator.render_backward(scene, params, dr.full(mi.TensorXf, 1.0, (8, 8, 3)), spp=2)
        dr.disable_grad(params[BOX])
    assert term.backward.told == [8 * 8 * 3]


def test_names_are_told_apart(llvm):
    with pytest.raises(ValueError, match="'primary'"), registered(dummy(name="primary")):
        pass
    assert len(TERMS) == 5
