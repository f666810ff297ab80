"""The mixed form: slides beside corners and contacts, stays on surfaces elsewhere, and is the same derivative."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import pytest
from helpers import assert_grad_close, forward, load, motion_of, spec_of
from problems import Problem

from psdr_jit.boundary import close_receivers
from psdr_jit.derivative.perturbation import Perturbation
from psdr_jit.paths import close_by
from psdr_jit.paths.recording import PathRecords

WIDE = 0.3  # reach at which half of the vertices slide
SPP, SEEDS, STDERR = 64, 12, 0.02
DEEP = {"max_depth": 4, "sppp": 0}  # outlines that the sensor sees are the same in all forms


@pytest.fixture
def corner(llvm, monkeypatch) -> tuple[mi.Scene, Perturbation]:
    """Two surfaces that meet, over which what a moving camera sees slides."""
    monkeypatch.setattr(close_by, "REACH", WIDE)
    problem = Problem("concave_corner", "camera.to_world", 0.01, direction=(0.6, 0.3, -0.5))
    scene = load(problem, res=16)
    return scene, motion_of(problem, scene)


@pytest.fixture
def spatial(corner):
    scene, motion = corner
    return forward(motion, spec_of(scene, form="spatial", **DEEP), SEEDS, SPP)


def test_agrees_with_the_spatial_form(corner, spatial):
    """In the material form alone the gain is known to 0.12 only."""
    scene, motion = corner
    assert_grad_close(forward(motion, spec_of(scene, form="mixed", **DEEP), SEEDS, SPP), spatial, STDERR)


def at_rest(records: PathRecords, k: mi.UInt32, active: mi.Bool, place=PathRecords.place):
    """Where vertices are, but that none slides after the first."""
    return replace(place(records, k, active), slides=k == 0)


WRONG = {  # gains and largest z of 12 seeds
    "boundary of the material form alone": (close_receivers, "close_by", lambda job, view: mi.Bool(False)),  # 1.10, 45
    "vertices stay": (PathRecords, "place", at_rest),  # 0.96, 6
}


@pytest.mark.parametrize("name", WRONG)
def test_forms_that_do_not_fit_together_are_told_apart(corner, spatial, monkeypatch, name):
    scene, motion = corner
    owner, attribute, wrong = WRONG[name]
    monkeypatch.setattr(owner, attribute, wrong)
    estimate = forward(motion, spec_of(scene, form="mixed", **DEEP), SEEDS, SPP)
    with pytest.raises(AssertionError):
        assert_grad_close(estimate, spatial, STDERR)


def test_no_other_form_asks_what_is_close_by(corner, monkeypatch):
    scene, motion = corner
    asked = []
    monkeypatch.setattr(close_by.CloseBy, "has", lambda *args: asked.append(args) or dr.full(mi.Bool, False))
    forward(motion, spec_of(scene, form="material", **DEEP), 2, 1)
    assert not asked
