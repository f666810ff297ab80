"""Outlines of smooth glass: seen edge-on it mirrors everything, straight on, so that nothing steps there."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward

from psdr_jit.derivative.perturbation import perturb

FILM = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
BUDGETS = ("sppc", "sppp", "sppd", "sppi", "spps")
SHAPES = {
    "sphere": {"type": "sphere", "center": [0.05, 0.03, 0], "radius": 0.6},
    "cylinder": {"type": "cylinder", "p0": [0.05, -3, 0], "p1": [0.06, 3, 0.1], "radius": 0.5},
}
BSDFS = {
    "glass": {"type": "dielectric"},
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.2},
    "window": {"type": "thindielectric"},
    "mirror": {"type": "conductor", "material": "none", "specular_reflectance": 0.5},
    "black": {"type": "diffuse", "reflectance": 0.0},
}


def before_a_glowing_wall(shape: str, bsdf: str) -> mi.Scene:
    """Beyond its depth everything is black: what is seen by way of more than one vertex is not in the image."""
    t = mi.ScalarTransform4f()
    return mi.load_dict({
        "type": "scene", "body": {**SHAPES[shape], "bsdf": BSDFS[bsdf]},
        "wall": {"type": "rectangle", "to_world": t.translate([0, 0, -1.5]).scale(6), "emitter": {"type": "area"}},
        "camera": {"type": "perspective", "fov": 30, "film": FILM,
                   "to_world": t.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])},
    })  # fmt: skip


def term_images(scene: mi.Scene, direction: tuple[float, ...], depth: int, seeds: int, **budget: int) -> np.ndarray:
    """Mean derivative image (H, W) by one term; `budget`: that of the term."""
    spec = {"type": "psdr_path", "max_depth": depth, "form": "spatial", **dict.fromkeys(BUDGETS, 0), **budget}
    return forward(perturb(scene, "body.to_world", direction), spec, seeds, *budget.values()).mean(0)[..., 0]


def term_alone(scene: mi.Scene, budget: str, spp: int) -> float:
    """Of the derivative by one term, the mean over seeds of the left half of the image less the right half."""
    d = term_images(scene, (1, 0.2, 0), 2, 4, **{budget: spp})
    return float(d[:, :6].sum() - d[:, 6:].sum())


@pytest.mark.parametrize("shape, bsdf", [("sphere", "glass"), ("sphere", "plastic"), ("sphere", "window"),
                                         ("cylinder", "glass")])  # fmt: skip
def test_the_outline_of_glass_is_no_step(llvm, shape, bsdf):
    """All of the change is in how the reflectance falls behind it; a little inside of the outline it has by 4 %."""
    scene = before_a_glowing_wall(shape, bsdf)
    assert abs(term_alone(scene, "sppp", 64)) < 0.01 * abs(term_alone(scene, "sppc", 256))


def test_a_mirror_that_swallows_half_steps_by_half(llvm):
    half, none = (term_alone(before_a_glowing_wall("sphere", bsdf), "sppp", 64) for bsdf in ("mirror", "black"))
    assert abs(none) > 1 and np.isclose(half, none / 2, rtol=0.01)


def test_nothing_steps_in_a_curved_mirror(llvm):
    """A glass ball under a white sky, seen in a mirror ball near its rim, which magnifies how far beside the outline
    one looks: what goes straight on from there through the ball once more is lost, as paths end then.
    """
    t = mi.ScalarTransform4f()
    crop = {"width": 24, "height": 18, "crop_offset_x": 2, "crop_offset_y": 8, "crop_width": 5, "crop_height": 4}
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant"},
        "body": {"type": "sphere", "radius": 1.5, "bsdf": {"type": "dielectric"}},
        "mirror": {"type": "sphere", "center": [-3, -0.5, 1], "bsdf": {"type": "conductor", "material": "none"}},
        "camera": {"type": "perspective", "fov": 40, "film": {**FILM, **crop},
                   "to_world": t.look_at(origin=[5.08, 4.05, 10.03], target=[0.08, 0.05, 0.03], up=[0, 1, 0])},
    })  # fmt: skip
    chain, interior = (
        term_images(scene, (0.6, 0.3, -0.5), 3, n, **b) for n, b in ((12, {"spps": 256}), (4, {"sppc": 256}))
    )
    assert abs(chain.sum()) < 0.03 * abs(interior.sum())  # .01; .065 without the point of contact
