"""Where bent normals turn from the viewer, what a bump or normal map sends steps: at the rims of balls, and on sheets
that are seen aslant.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward

from psdr_jit.derivative.perturbation import perturb

slow = pytest.mark.slow
STEP, SEEDS = 0.002, 32  # of finite differences [scene units, rad]
MAX_STDERR = 0.02

pytestmark = pytest.mark.usefixtures("llvm")


def picture(values: np.ndarray) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}


def normals(steep: float = 1.0) -> dict:
    n = steep * np.random.default_rng(3).uniform(-0.15, 0.15, (6, 6, 3)) * [1, 1, 0] + [0.5, 0.5, 0.95]
    return {"type": "normalmap", "normalmap": picture(n), "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def steep() -> dict:
    return normals(3)


def one_tilt() -> dict:
    """Normals of one direction: where they turn from a viewpoint is a straight line."""
    n = np.full((2, 2, 3), [0.85, 0.5, 0.65])
    return {"type": "normalmap", "normalmap": picture(n), "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def bumps(texels: int = 8) -> dict:
    heights = picture(np.random.default_rng(4).random((texels, texels, 1)))
    return {"type": "bumpmap", "heights": heights, "scale": 0.3, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def scene_of(plugin: str, bsdf: dict, pose, eye: tuple) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    view = mi.ScalarTransform4f().look_at(eye, [0.1, 0.5, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 32, "to_world": view, "film": film}
    body = {"type": plugin, "to_world": pose, "bsdf": {"type": "twosided", "of": bsdf}}
    lamp = {"type": "point", "position": [0.9, 2.3, 1.6], "intensity": 6.0}
    return mi.load_dict({"type": "scene", "body": body, "lamp": lamp, "camera": camera}, optimize=False)


def ball():
    return mi.ScalarTransform4f().translate([0.1, 0.6, 0]).rotate([0.48, 0.6, 0.64], 33).scale([0.6] * 3)


def sheet():
    return mi.ScalarTransform4f().translate([0.1, 0.5, 0]).rotate([0.96, 0.28, 0], -75).rotate([0, 0, 1], 60)


ABOVE, ASLANT = (1.5, 2.4, 2.9), (1.5, 1.6, 3.2)
MOVED, TURNED = {"direction": (0.3, 0.5, 0.2)}, {"rotate": (0.6, 0, 0.8)}
CASES = [
    pytest.param("rectangle", one_tilt, sheet, ASLANT, "body.to_world", TURNED, 256, id="turned sheet of one tilt"),
    pytest.param("sphere", normals, ball, ABOVE, "body.to_world", MOVED, 1024, id="moved ball", marks=slow),
    pytest.param("rectangle", bumps, sheet, ASLANT, "camera.to_world", TURNED, 4096, id="camera", marks=slow),
    pytest.param("disk", steep, sheet, ASLANT, "body.to_world", TURNED, 2048, id="disk", marks=slow),
    pytest.param("cylinder", partial(bumps, 16), ball, ABOVE, "body.to_world", TURNED, 4096, id="bumps", marks=slow),
    pytest.param("cylinder", normals, ball, ABOVE, "body.to_world", TURNED, 2048, id="cylinder", marks=slow),
]


@pytest.mark.parametrize(("plugin", "bsdf", "pose", "eye", "param", "how", "spp"), CASES)
def test_against_differences(plugin, bsdf, pose, eye, param, how, spp):
    """Without these edges the gain of the sheet of one tilt is .3; on balls, they are up to 4 %."""
    motion = perturb(scene_of(plugin, bsdf(), pose(), eye), param, **how)
    spec = {"type": "psdr_path", "max_depth": 2}
    assert_grad_close(forward(motion, spec, SEEDS, spp // 16), fd(motion, spec, STEP, SEEDS, spp), MAX_STDERR)


def test_transpose():
    """Backward mode has the motion of bent normals as forward mode has it."""
    scene = scene_of("sphere", normals(), ball(), ABOVE)
    spec = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 16, "sppd": 4, "sppi": 4}
    one, other = adjoint_identity(scene, "body.to_world", mi.load_dict(spec))[:2]
    assert one == pytest.approx(other, rel=1e-4) and one != 0
