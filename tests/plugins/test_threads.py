"""Derivatives in several threads: functions of ours wait for each other, what cannot wait is refused."""

from __future__ import annotations

import threading

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import UnsupportedError
from psdr_jit.scene import io as scene_io

PARAMETER = "blocker.vertex_positions"
INTEGRATOR = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4}


def load():
    return scene_io.load_scene(scene_io.shipped_scene("point_shadow.xml"), res=16)


def derivative(scene):
    return psdr_jit.gradient(scene, PARAMETER, (1, 0, 0), spp=4, seeds=4, integrator=INTEGRATOR).total


@pytest.mark.slow
def test_two_threads_that_differentiate_wait_for_each_other(llvm):
    scenes, found, errors = [load(), load()], {}, []
    expected = derivative(scenes[0])

    def work(k: int) -> None:
        try:
            mi.set_variant(llvm)  # which a thread does not inherit
            for _ in range(3):
                found[k] = derivative(scenes[k])
        except RuntimeError as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(scenes))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    for image in found.values():
        assert np.allclose(image, expected, atol=1e-5 * np.abs(expected).max())


def test_an_integrator_does_not_start_beside_another_thread(llvm):
    scene, other = load(), load()
    motion = perturb(other, PARAMETER, (1, 0, 0))
    caught = []

    def intrude() -> None:
        mi.set_variant(llvm)
        with pytest.raises(UnsupportedError, match="another thread is computing a derivative"):
            mi.load_dict(INTEGRATOR).render_forward(other, motion.params)
        caught.append(True)

    def meanwhile(done: int, total: int) -> None:
        if done == 1:
            thread = threading.Thread(target=intrude)
            thread.start()
            thread.join()

    psdr_jit.gradient(scene, PARAMETER, (1, 0, 0), spp=1, seeds=1, integrator=INTEGRATOR, progress=meanwhile)
    assert caught
    motion.attach()
    mi.load_dict(INTEGRATOR).render_forward(other, motion.params)  # afterwards it does
