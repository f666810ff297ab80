"""Normals as the parameter: the surface rests, and where it turns from the viewer slides over it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward
from test_smooth_meshes import LIGHT, REFLECTOR, scene_of, sphere
from variants import also

from psdr_jit import make_plan
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import gain

NORMALS = "shape.vertex_normals"
STEP = 0.004  # of the normals
SEEDS = 16

pytestmark = pytest.mark.usefixtures("llvm")


def leaning(kind: dict) -> Perturbation:
    """All normals of a coarse sphere, lengthened in one direction."""
    scene = scene_of(sphere(8, **kind))
    count = np.array(mi.traverse(scene)[NORMALS]).size // 3
    return perturb(scene, NORMALS, np.tile(np.array([0.3, -0.4, 0.9], np.float32), count))


KINDS = [also(LIGHT, 4096, 0.9), also(REFLECTOR, 1024, 0.02)]


@pytest.mark.parametrize("kind, spp, off", KINDS, ids=["light", "reflector"])
def test_turned_normals(kind, spp, off):
    """Without `primary`, which plans left out while only normals changed, the gain is off by more than `off`."""
    motion, spec = leaning(kind), {"type": "psdr_path", "max_depth": 2}
    differences = fd(motion, spec, STEP, SEEDS, spp)
    slopes = [gain(forward(motion, options, SEEDS, 256), differences[::2], differences[1::2])
              for options in (spec, spec | {"sppp": 0})]  # fmt: skip
    assert slopes[0].stderr < 0.03 and abs(slopes[0].value - 1) < 0.01 + 2 * slopes[0].stderr, slopes
    assert abs(slopes[1].value - 1) > off, slopes


def test_transpose():
    scene = scene_of(sphere(8, **REFLECTOR))
    spec = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppd": 4, "sppi": 4}
    one, other = adjoint_identity(scene, NORMALS, mi.load_dict(spec))[:2]
    assert one == pytest.approx(other, rel=1e-4) and one != 0


def test_the_plan_has_what_slides():
    plan = make_plan(scene_of(sphere(8, **REFLECTOR)), NORMALS, spp=1)
    assert "primary" in [term.name for term in plan.running]
