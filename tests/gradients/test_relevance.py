"""Edges that are left out contribute nothing: sampled alone, they give an image of zeros."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, load, motion_of, spec_of
from problems import named

from psdr_jit.derivative.perturbation import perturb

CASES = [
    ("area_shadow", "blocker.vertex_positions"),
    ("area_shadow", "light.to_world"),
    ("point_shadow", "blocker.vertex_positions"),
    ("cbox", "small-box.vertex_positions"),
]


def directional() -> mi.Scene:
    """A cube over a floor under a distant light."""
    floor = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)
    look = mi.ScalarTransform4f().look_at(origin=[0.5, 2, 4], target=[0, -0.5, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "floor": {"type": "rectangle", "to_world": floor},
        "blocker": {"type": "cube", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 30).scale(0.3)},
        "sun": {"type": "directional", "direction": [-0.3, -1, -0.2]},
    })  # fmt: skip


@pytest.mark.parametrize(("scene_name", "param"), CASES)
def test_pruned_edges_cast_no_shadow(llvm, monkeypatch, scene_name, param):
    problem = named(scene_name, param)
    scene = load(problem, res=16)
    require_nothing_dropped(monkeypatch, motion_of(problem, scene), spec_of(scene, "direct"))


def test_pruned_edges_of_a_distant_light(llvm, monkeypatch):
    scene = directional()
    motion = perturb(scene, "blocker.vertex_positions", (1, 0, 0))
    require_nothing_dropped(monkeypatch, motion, spec_of(scene, "direct"))


def require_nothing_dropped(monkeypatch, motion, spec):
    from psdr_jit.boundary import direct
    from psdr_jit.sampling import relevance

    dropped = []

    def only_dropped(job, rows):
        keep = relevance.can_cast_shadow(job, rows)
        dropped.append(int(np.count_nonzero(~np.array(keep))))
        return dr.select(keep, 0, mi.Float(1))

    assert np.abs(forward(motion, spec, 1, 64)).max() > 0
    monkeypatch.setattr(direct, "_shadow_weight", only_dropped)
    assert not forward(motion, spec, 1, 64).any()
    assert sum(dropped) >= 4
