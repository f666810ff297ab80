"""A board that reaches into a post, both flush in front: the same to look at as a board that ends at the post."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward
from variants import also

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import block_means

SPP, SEEDS = 64, 12


def joint(overlap: float) -> mi.Scene:
    pose = mi.ScalarTransform4f()
    grey = {"type": "diffuse", "reflectance": 0.5}
    film = {"type": "hdrfilm", "width": 20, "height": 20, "rfilter": {"type": "box"}, "pixel_format": "luminance"}

    def block(centre: tuple[float, ...], half: tuple[float, ...]) -> dict:
        return {"type": "cube", "to_world": pose.translate(list(centre)).scale(list(half)), "bsdf": grey}

    return mi.load_dict({
        "type": "scene", "post": block((0, 0.5, 0), (0.2, 0.5, 0.3)),
        "board": block((0.5 - overlap / 2, 0.5, 0), (0.3 + overlap / 2, 0.2, 0.3)),
        "floor": {"type": "rectangle", "to_world": pose.rotate([1, 0, 0], -90).scale(4), "bsdf": grey},
        "lamp": {"type": "rectangle", "to_world": pose.look_at([1, 3, 1], [0, 0, 0], [0, 0, 1]).scale(0.5),
                 "light": {"type": "area", "radiance": 8.0}},
        "sensor": {"type": "perspective", "fov": 35, "film": film,
                   "to_world": pose.look_at([0, 1.2, 4], [0.2, 0.4, 0], [0, 1, 0])},
    }, optimize=False)  # fmt: skip


@pytest.mark.parametrize("overlap", [also(0.02), 0.1])
def test_what_lies_inside_is_not_seen(llvm, overlap):
    """The end of the board had cast a seam over the post, 35 % of the image."""
    images = []
    for reach in (overlap, 0.0):
        motion = perturb(joint(reach), "sensor.to_world", (1, 0, 0))
        images.append(forward(motion, {"type": "psdr_path", "max_depth": 3}, SEEDS, SPP).mean(0))
    blocks = [block_means(image, 4) for image in images]
    assert np.abs(blocks[0] - blocks[1]).max() < 0.03 * np.abs(blocks[1]).max()
