"""No scene is collected while kernels are put together: Dr.Jit would end the process."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest
from helpers import load
from problems import Problem

from psdr_jit import make_plan
from psdr_jit.core.collection import nothing_collected
from psdr_jit.interior import spatial
from psdr_jit.paths import light_walk

BLOCKER = "blocker.vertex_positions"


def forward(scene: mi.Scene, params: mi.SceneParameters) -> None:
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    dr.set_grad(params[BLOCKER], 1.0)
    params.update()
    integrator.render_forward(scene, params, spp=1)


def backward(scene: mi.Scene, params: mi.SceneParameters) -> None:
    dr.backward(mi.render(scene, params, integrator=mi.load_dict({"type": "psdr_path", "max_depth": 2}), spp=1))


def planned(scene: mi.Scene, params: mi.SceneParameters) -> None:
    make_plan(scene, params, integrator={"type": "psdr_path", "max_depth": 2}, spp=1)  # by a pilot


@pytest.mark.parametrize("use", [forward, backward, planned])
def test_the_collector_rests_meanwhile(llvm, monkeypatch, use):
    seen, original = [], spatial.next_event

    def spy(*how):
        seen.append(gc.isenabled())
        return original(*how)

    monkeypatch.setattr(spatial, "next_event", spy)
    scene = load(Problem("area_shadow", BLOCKER, 0.0), res=8)
    params = mi.traverse(scene)
    dr.enable_grad(params[BLOCKER])
    params.update()
    use(scene, params)
    assert seen and not any(seen) and gc.isenabled()


def test_it_rests_while_images_are_made_from_the_light(llvm, monkeypatch):
    seen, original = [], light_walk.bounce

    def spy(*how):
        seen.append(gc.isenabled())
        return original(*how)

    monkeypatch.setattr(light_walk, "bounce", spy)
    mi.render(load(Problem("rough_glass", "", 0.0), res=8), integrator=mi.load_dict({"type": "psdr_bdpt"}), spp=1)
    assert seen and not any(seen) and gc.isenabled()


def test_it_goes_on_as_before():
    with pytest.raises(ZeroDivisionError), nothing_collected(), nothing_collected():
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with nothing_collected():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
