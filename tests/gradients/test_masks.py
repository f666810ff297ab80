"""Half-opaque masks: images and derivatives are the means of those with the surface and without it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

SEEDS, SPP = 16, 256
BLACK, WHITE = ({"type": "diffuse", "reflectance": value} for value in (0.0, 0.8))
SPEC = {"type": "psdr_path", "max_depth": 4, "rr_depth": 1000}


def T() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def scene_of(**shapes: dict) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    pose = T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    camera = {"type": "perspective", "fov": 20, "to_world": pose, "film": film}
    return mi.load_dict({"type": "scene", "camera": camera, **shapes}, optimize=False)


def half(bsdf: dict) -> dict:
    return {"type": "mask", "opacity": 0.5, "bsdf": bsdf}


def card_under_the_sun(bsdf: dict) -> mi.Scene:
    """Nothing lies behind it, not even a sky."""
    pose = T().look_at(origin=[0.5, 0.3, 2], target=[0, 0, 0], up=[0, 1, 0])
    card = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], 20), "bsdf": bsdf}
    return scene_of(card=card, sun={"type": "directional", "to_world": pose, "irradiance": 2.0})


def test_what_is_passed_takes_nothing_of_what_is_reflected(llvm):
    """Mitsuba's `path` drops the light of paths that go on through the mask and leave the scene."""
    images = [np.array(integrator_specs.build(SPEC).render(card_under_the_sun(bsdf), seed=0, spp=SPP), np.float64)
              for bsdf in (half(WHITE), WHITE)]  # fmt: skip
    np.testing.assert_allclose(2 * images[0].mean(), images[1].mean(), rtol=1e-3)


def test_a_sun_that_turns(llvm):
    opaque, masked = (
        forward(perturb(card_under_the_sun(bsdf), "sun.to_world", rotate=(0.2, 1, 0.1)), SPEC, SEEDS, SPP)
        for bsdf in (WHITE, half(WHITE))
    )
    np.testing.assert_allclose(2 * masked.mean(0), opaque.mean(0), rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_a_shadow_behind_a_mask(llvm):
    """Shadow edges on the wall, seen straight through flat faces, whose normals follow nothing."""

    def moved(**window: dict) -> np.ndarray:
        block = {"type": "cube", "to_world": T().translate([1.2, 0.1, 0.8]).scale(0.3), "bsdf": BLACK}
        lamp = {"type": "point", "position": [3, 0.2, 2], "intensity": 20.0}
        wall = {"type": "rectangle", "to_world": T().scale(2), "bsdf": WHITE}
        scene = scene_of(wall=wall, block=block, lamp=lamp, **window)
        return forward(perturb(scene, "block.vertex_positions", direction=(1, 0.3, 0.2)), SPEC, SEEDS, SPP)

    pane = {"type": "rectangle", "to_world": T().translate([0, 0, 3]).scale(0.3)}
    seen, plain = moved(pane={**pane, "bsdf": half(BLACK)}).mean(0), moved().mean(0)
    assert np.linalg.norm(2 * seen - plain) < 0.01 * np.linalg.norm(plain)  # noise is far below what rays are lifted by
