"""The shipped optimisations by caustics of smooth glass: their targets show what the run's integrator shows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from psdr_jit.inverse import config, loop
from psdr_jit.scene import io as scene_io

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


def read(name: str, **changes) -> config.Config:
    found = config.read(scene_io.shipped_scene(f"inverse/{name}.toml"), **changes)
    targets = tuple({**target, "render": 32} for target in found.targets)
    return dataclasses.replace(found, targets=targets, defaults={**found.defaults, "res": 24})


def test_targets_show_the_caustic(llvm):
    """Also to an integrator that cannot: it is compared by the same target."""
    ours = read("smooth_caustic")
    peer = config.with_integrator(ours, "prb_projective")
    seen, same = (np.array(config.problem_of(c).views[0].target) for c in (ours, peer))
    path = np.array(config.problem_of(dataclasses.replace(peer, shown_by="psdr_path")).views[0].target)
    assert np.allclose(seen, same, rtol=1e-4) and seen.max() > 5 * path.max()


@pytest.mark.slow
def test_a_lens_takes_shape(llvm):
    """A few iterations bring the image of its caustic closer to that of the picture."""
    result = loop.run(config.problem_of(read("lens", iterations=8)))
    assert result.losses[-1] < 0.7 * result.losses[0]
