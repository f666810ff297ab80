"""The contract of a row sampler: what it is told, and when."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.sampling.rows import ROW_SAMPLER, WeightedRows
from psdr_jit.scene import io as scene_io

BUDGETS = {"sppc": 1, "sppp": 8, "sppi": 8}


class Listener(WeightedRows):
    """Samples as the default does, and writes down what it hears."""

    def __init__(self):
        self.states: list[str] = []
        self.heard: list[tuple[int, int, np.ndarray]] = []

    def init(self, what, weights):
        self.states.append(what)
        return super().init(what, weights)

    def learn(self, state, row, t, worth):
        self.heard.append((dr.width(row), dr.width(t), np.array(worth())))


@pytest.mark.parametrize("form", ["spatial", "material"])
def test_it_is_asked_once_in_a_call_and_told_by_every_term(llvm, form):
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=16)
    motion = perturb(scene, "small-box.vertex_positions", (1, 0, 0))
    spec = {"type": "psdr_path", "max_depth": 4, "form": form, **BUDGETS}
    images = []
    for sampler in (WeightedRows(), Listener()):
        integrator = integrator_specs.build(spec)
        integrator.memory[ROW_SAMPLER] = sampler
        motion.attach()
        images.append(np.array(integrator.render_forward(scene, motion.params, seed=1)))
    motion.restore()
    assert np.allclose(*images, rtol=1e-4, atol=1e-6 * np.abs(images[0]).max())  # sums in another order
    indirect = {"spatial": "indirect/step", "material": "indirect/background"}[form]
    assert sorted(sampler.states) == sorted(["primary", "direct/shadow", indirect])
    assert len(sampler.heard) == 3
    for rows, ts, worth in sampler.heard:
        assert rows == ts == len(worth) > 0
        assert np.isfinite(worth).all() and (worth >= 0).all() and worth.any()


def test_a_probe_teaches_nothing(llvm):
    """Automatic budgets run a pilot along a probe's motion first; the states serve both."""
    scene = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=8)
    motion = perturb(scene, "blocker.vertex_positions", (1, 0, 0))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "form": "spatial"})
    integrator.memory[ROW_SAMPLER] = listener = Listener()
    motion.attach()
    integrator.render_forward(scene, motion.params, seed=1, spp=2)
    motion.restore()
    assert sorted(listener.states) == ["direct/shadow", "primary"] and len(listener.heard) == 2
