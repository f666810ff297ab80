"""The material and the mixed form: the same derivative as the spatial one, and forward and backward mode agree."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward, load, motion_of, spec_of
from problems import PROBLEMS, Problem
from test_adjoint import CASES, SIZE, TOLERANCE
from variants import also

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.paths import close_by

QUICK = ("sunk_box",)  # light that is scattered twice, and curves of contact
ADJOINT = ("sky", "shadow", "sunk-mesh", "sunk-ball", "floor-around-ball", "camera-pose", "area-light-pose", "radiance")


FORMS = "material", "mixed"
WIDE = 0.05  # reach of the mixed form at which a good part of the vertices slides
CONTACT, SAID_OFF = "in the material form, which this integrator was asked for", 0.1  # its warning at contacts


@pytest.fixture(params=FORMS)
def form(request, monkeypatch):
    """A form, the mixed one with its two kinds of vertices side by side."""
    monkeypatch.setattr(close_by, "REACH", WIDE)
    return request.param


def compare(p: Problem, form: str, seeds: int, spp: int, max_stderr: float, **size) -> None:
    scene = load(p, **size)
    motion = motion_of(p, scene)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UnsupportedWarning)
        spatial, other = (forward(motion, spec_of(scene, form=f, **p.options), seeds, spp) for f in ("spatial", form))
    for w in said:
        if CONTACT not in str(w.message):
            warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
    if any(CONTACT in str(w.message) for w in said):
        assert form == "material"
        off = gain(other, spatial[0::2], spatial[1::2]).value - 1
        assert abs(off) < SAID_OFF, off
        return
    if np.allclose(spatial, other, rtol=1e-4, atol=1e-5 * np.abs(spatial).max()):
        return  # one vertex between light and sensor: the forms are the same
    assert_grad_close(other, spatial, max_stderr)


@pytest.mark.slow
@pytest.mark.parametrize("problem", [pytest.param(p, id=p.id) for p in PROBLEMS if p.scene in QUICK and not p.slow])
def test_forms_agree(llvm, form, problem):
    compare(problem, form, seeds=12, spp=96, max_stderr=0.08, **SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("problem", [pytest.param(p, id=p.id) for p in PROBLEMS])
def test_forms_agree_on_every_scene(llvm, form, problem):
    compare(problem, form, seeds=64, spp=128, max_stderr=0.03)


@pytest.mark.slow
def test_material_form_against_finite_differences(llvm):
    """A light behind a baffle: all that moves on the floor has been scattered before."""
    problem = next(p for p in PROBLEMS if p.scene == "baffled_light")
    scene = load(problem)
    motion = motion_of(problem, scene)
    estimate = forward(motion, spec_of(scene, form="material"), 12, 128)
    reference = fd(motion, spec_of(scene), problem.eps, 24, 256)
    assert_grad_close(estimate, reference, 0.06)


SLOW = ("floor-around-ball", "camera-pose", "sunk-ball")  # many kernels to compile on a fresh machine
QUICK_ADJOINTS = [(case, "material") for case in ADJOINT if case not in SLOW] + [("sunk-mesh", "mixed")]


@pytest.mark.parametrize(
    ("case", "form"), [(c, f) if (c, f) in QUICK_ADJOINTS else also(c, f) for f in FORMS for c in ADJOINT]
)
def test_forward_and_backward_agree(variant, monkeypatch, case, form):
    monkeypatch.setattr(close_by, "REACH", WIDE)
    scene_name, param, _ = CASES[case]
    scene = load(Problem(scene_name, param, 0.0), **SIZE)
    integrator = integrator_specs.build(spec_of(scene, form=form, max_depth=4))
    wJv, JTwv, w, Jv = adjoint_identity(scene, param, integrator)
    assert Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"
