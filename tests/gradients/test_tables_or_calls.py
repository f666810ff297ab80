"""Whether surfaces are looked up in tables or asked for by calls, the derivative is the same, sample by sample."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, forward

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.scene import io as scene_io
from psdr_jit.scene import mesh_tables

SHIFT, TURN = {"direction": (1, 0.5, 0.2)}, {"rotate": (1, 1, 0)}
#: Scene, parameter, its motion, and how long paths are; first what is looked at in every run, in one form.
FAST = [
    ("ball_shadow", "blocker.to_world", SHIFT, 3),
]
SLOW = [
    ("cbox", "small-box.vertex_positions", SHIFT, 4), ("patterns", "floor.to_world", SHIFT, 2),
    ("cbox", "sensor.to_world", SHIFT, 3), ("cbox", "light.to_world", SHIFT, 3),
    ("ball_shadow", "floor.to_world", SHIFT, 3), ("smooth_ball_shadow", "blocker.vertex_positions", SHIFT, 3),
    ("smooth_ball_shadow", "blocker.vertex_positions", TURN, 3),
    ("environment_shadow", "blocker.vertex_positions", SHIFT, 3), ("patterns", "ball.to_world", TURN, 2),
    ("glass", "body.to_world", SHIFT, 4), ("mirrors", "mirror.to_world", {"rotate": (1, 0, 0)}, 4),
    ("rough_glass", "ball.bsdf.eta", {}, 4), ("sunk_ball", "ball.to_world", SHIFT, 2),
]  # fmt: skip
CASES = [(*case, "spatial") for case in FAST] + [
    pytest.param(*case, form, marks=pytest.mark.slow)
    for case, form in [(case, "material") for case in FAST] + [(c, f) for c in SLOW for f in ("spatial", "material")]
]
ALWAYS, NEVER = 1, 1000  # shapes from which on there are tables
SPEC = {"type": "psdr_path", "guide": "off", "sppc": 16, "sppp": 16, "sppi": 16, "sppd": 16, "spps": 16}


@pytest.mark.parametrize(("name", "param", "how", "depth", "form"), CASES)
@pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")
def test_they_agree(llvm, monkeypatch, name, param, how, depth, form):
    spec, images, products = {**SPEC, "max_depth": depth, "form": form}, [], []
    for fewest in (ALWAYS, NEVER):
        monkeypatch.setattr(mesh_tables, "FEWEST", fewest)
        scene = scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), res=16)
        images.append(forward(perturb(scene, param, **how), spec, 2, 16))
        scene = scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), res=16)
        a, b, w, Jv = adjoint_identity(scene, param, mi.load_dict(spec), spp=16)
        assert abs(a - b) < 1e-3 * w * Jv
        products.append(b / (w * Jv))
    tables, calls = images
    off = np.abs(tables - calls)
    assert np.abs(calls).max() > 0 and off.sum() < 0.01 * np.abs(calls).sum()
    assert abs(products[0] - products[1]) < 0.01
