"""Forward mode by `mi.render` and `dr.forward` is what it is with tangents that were in the scene before."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("llvm")


def load() -> mi.Scene:
    look = mi.ScalarTransform4f().look_at
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "film": film, "to_world": look([0, -4, 3], [0, 0, 0], [0, 0, 1])},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]).scale(0.4),
                "bsdf": {"type": "roughplastic", "nonlinear": True}},
        "spot": {"type": "spot", "to_world": look([1, -1, 4], [0, 0, 0], [0, 1, 0]), "intensity": 20.0,
                 "cutoff_angle": 25, "beam_width": 15},
    }, optimize=False)  # fmt: skip


@pytest.mark.parametrize("name", ["sensor.x_fov", "spot.cutoff_angle", "spot.beam_width", "box.bsdf.eta"])
def test_values_that_mitsuba_computes_from_a_parameter_have_their_tangents(name):
    budgets = {"sppc": 8, "sppp": 8, "sppi": 8, "sppd": 8}
    images, seed = {}, 5
    for way in ("render", "before"):
        scene = load()
        params, integrator = mi.traverse(scene), mi.load_dict({"type": "psdr_path", "max_depth": 3, **budgets})
        θ = mi.Float(0)
        dr.enable_grad(θ)
        base = float(params[name][0])
        params[name] = base * (1 + θ)
        params.update()
        if way == "before":
            dr.forward(θ, dr.ADFlag.ClearEdges)
            image = integrator.render_forward(scene, params, seed=seed, spp=8)
        else:
            primal = mi.render(scene, params, integrator=integrator, spp=8, seed_grad=seed)
            dr.forward(θ)
            image = dr.grad(primal)
        images[way] = np.array(image)
        assert float(params[name][0]) == base and dr.grad_enabled(params[name])
    assert np.abs(images["before"]).max() > 0
    assert np.allclose(images["render"], images["before"], atol=1e-5 * np.abs(images["before"]).max())
