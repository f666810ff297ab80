"""Cylinders that disks close: their rims are one edge. A prism of many sides is much the same body."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward
from variants import also

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import block_means

SPP, SEEDS, STEP = 256, 12, 0.01
SPEC = {"type": "psdr_path", "max_depth": 3}
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def can(camera: tuple[float, float, float], ends: int = 1) -> mi.Scene:
    """Closed at the top, or at both ends, over a floor and under a lamp."""
    pose = mi.ScalarTransform4f()
    lids = {f"lid{k}": {"type": "disk", "to_world": pose.translate([0, height, 0]).rotate([1, 0, 0], -90).scale(0.6),
                        "bsdf": GREY} for k, height in enumerate((0.5, -0.3)[:ends])}  # fmt: skip
    film = {"type": "hdrfilm", "width": 20, "height": 20, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    lamp = pose.look_at([1, 3, 1], [0, 0, 0], [0, 0, 1]).scale(0.5)
    return mi.load_dict({
        "type": "scene", "wall": {"type": "cylinder", "p0": [0, -0.3, 0], "p1": [0, 0.5, 0], "radius": 0.6,
                                  "bsdf": GREY}, **lids,
        "floor": {"type": "rectangle", "to_world": pose.translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(4)},
        "lamp": {"type": "rectangle", "to_world": lamp, "light": {"type": "area", "radiance": 8.0}},
        "sensor": {"type": "perspective", "fov": 35, "film": film,
                   "to_world": pose.look_at(list(camera), [0, 0.1, 0], [0, 1, 0])},
    }, optimize=False)  # fmt: skip


CASES = [also("above", "sensor.to_world"), also("above", "lamp.to_world"), also("level", "sensor.to_world"),
         also("level", "lamp.to_world")]  # fmt: skip
FROM = {"above": (0.2, 1.8, 3.5), "level": (0.2, 0.3, 4.0)}


@pytest.mark.parametrize("camera, moved", CASES)
def test_a_can_at_rest(llvm, camera, moved):
    """Blocks were three times as large where the lid meets the wall."""
    motion = perturb(can(FROM[camera], 2), moved, (1, 0.3, 0))
    ours, differences = forward(motion, SPEC, SEEDS, SPP), fd(motion, SPEC, STEP, SEEDS, 4 * SPP)
    blocks = [block_means(x, 4) for x in (ours, differences)]
    (a, b), errors = (x.mean(0) for x in blocks), [x.std(0) / np.sqrt(len(x)) for x in blocks]
    assert np.abs((a - b) / np.sqrt(errors[0] ** 2 + errors[1] ** 2 + (0.03 * np.abs(b).max()) ** 2)).max() < 4
