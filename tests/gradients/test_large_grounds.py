"""What stands on a ground a thousand times its size casts shadows: the far borders do not take all samples.

Without `sampling.nearness`, blocks of pixels come out as 0 with an error of 0 on the largest ground, where the truth is
−.25, and the sum over the image has 300 times the error.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from helpers import forward

from psdr_jit.derivative.perturbation import perturb

SIZES = (30.0, 1e3, 1e4)
SEEDS, BLOCK = 8, 4


def scene_of(size: float) -> mi.Scene:
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": 0.3},
        "camera": {"type": "perspective", "fov": 40, "far_clip": 1e5, "film": film,
                   "to_world": T.look_at([0, 2, 5], [0, 0.2, 0], [0, 1, 0])},
        "ground": {"type": "rectangle", "to_world": T.rotate([1, 0, 0], -90).scale(size)},
        "box": {"type": "cube", "to_world": T.translate([0, 0.7, 0]).rotate([0, 1, 0], 20).scale(0.5)},
    }, optimize=False)  # fmt: skip


def test_shadows_on_it_have_their_samples(llvm):
    spec = {"type": "psdr_path", "max_depth": 2, "sppc": 0, "sppp": 0, "sppi": 0, "sppd": 256}
    found = []
    for size in SIZES:
        images = forward(perturb(scene_of(size), "camera.to_world", (0.5, 1, 0.2)), spec, SEEDS, 64)
        near = images[:, BLOCK:]  # what is seen of the ground there is on all of them
        blocks = near.reshape(SEEDS, -1, BLOCK, 16 // BLOCK, BLOCK).mean((2, 4)).reshape(SEEDS, -1)
        found.append((blocks.mean(0), blocks.std(0, ddof=1) / np.sqrt(SEEDS)))
    (value, error), *others = found
    assert np.abs(value).max() > 15 * error.max()
    for other, its_error in others:
        assert its_error.max() < 4 * error.max()
        assert np.abs(other - value).max() < 5 * np.hypot(error, its_error).max()
