"""Edges that are left out contribute nothing: sampled alone, they give an image of zeros."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, load, motion_of, spec_of
from problems import named

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.sampling.rows import ROW_SAMPLER, WeightedRows

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
def test_pruned_edges_cast_no_shadow(llvm, scene_name, param):
    problem = named(scene_name, param)
    scene = load(problem, res=16)
    require_nothing_dropped(motion_of(problem, scene), spec_of(scene, "direct"))


def test_pruned_edges_of_a_distant_light(llvm):
    scene = directional()
    motion = perturb(scene, "blocker.vertex_positions", (1, 0, 0))
    require_nothing_dropped(motion, spec_of(scene, "direct"))


class OnlyDropped(WeightedRows):
    """Draws the rows that no light can see as an outline, and only these."""

    def __init__(self):
        self.dropped = 0

    def init(self, term, weights):
        keep = [dr.select(w == 0, mi.Float(1), 0) for w in weights]
        self.dropped += sum(int(np.count_nonzero(np.array(k))) for k in keep)
        return super().init(term, keep)


def require_nothing_dropped(motion, spec):
    assert np.abs(forward(motion, spec, 1, 64)).max() > 0
    integrator, rows = integrator_specs.build(spec), OnlyDropped()
    integrator.memory[ROW_SAMPLER] = rows
    motion.attach()
    image = np.array(integrator.render_forward(motion.scene, motion.params, spp=64))
    motion.restore()
    assert not image.any() and rows.dropped >= 4
