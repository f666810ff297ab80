"""Light subpaths from the sky: `psdr_bdpt` finds what a sun in an environment map sends through rough glass.

`light_paths="only"` leaves to them all that they find: nothing else makes up for what they get wrong.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, assert_image_of_path, forward
from variants import also

from psdr_jit import make_plan
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.plan.light_plan import LARGE, sky_solid_angle

LIMITS = {"max_depth": 5, "rr_depth": 1000}
INTERIOR = {"form": "spatial", "sppc": 64, "sppp": 0, "sppd": 0, "sppi": 0, "spps": 0}
BODIES = {
    "glass": {"type": "roughdielectric", "alpha": 0.1, "distribution": "ggx"},
    "metal": {"type": "roughconductor", "alpha": 0.1, "distribution": "ggx"},
    "smooth": {"type": "dielectric"},
}
ROWS = 128  # of the map
SUN, HAZE = 0.01, 0.6  # widths of what shines [rad]
SUN_AT = [0.35, 0.3, 0.9]  # z upwards
Z_LIMIT = 4.5
TOLERANCE = 1e-5  # of the adjoint identity
SEEDS = 16


def sky(width: float, **more) -> dict:
    """A sun, a Gaussian of this width, in an even sky."""
    θ, φ = np.meshgrid((np.arange(ROWS) + 0.5) * np.pi / ROWS, (np.arange(2 * ROWS) + 0.5) * np.pi / ROWS,
                       indexing="ij")  # fmt: skip
    d = np.stack([np.sin(θ) * np.sin(φ), np.cos(θ), -np.sin(θ) * np.cos(φ)], -1)
    up = np.array([0.35, 0.9, 0.3])
    shine = np.exp(-0.5 * (np.arccos(np.clip(d @ (up / np.linalg.norm(up)), -1, 1)) / width) ** 2)
    radiance = 0.2 + 3 * shine / (shine * np.sin(θ)).sum() * (ROWS / np.pi) ** 2
    bitmap = mi.Bitmap(np.repeat(radiance[..., None], 3, -1).astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, **more}


def scene_of(body: str, light: dict) -> mi.Scene:
    """A ball on a floor below the sky."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}}
    view = T().look_at(origin=[0, 2.2, 3], target=[0, 0, 0], up=[0, 1, 0])
    return mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 34, "to_world": view, "film": film}, "sky": light,
        "floor": {"type": "rectangle", "to_world": T().translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(3)},
        "body": {"type": "sphere", "radius": 0.45, "center": [0.05, 0.1, 0], "bsdf": BODIES[body]},
    }, optimize=False)  # fmt: skip


def only(**options) -> dict:
    return {"type": "psdr_bdpt", "light_paths": "only", **LIMITS, **options}


def sunsky() -> dict:
    """A sun with a hard rim."""
    return {"type": "sunsky", "sun_direction": SUN_AT, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90)}


LIGHTS = {"sun": lambda: sky(0.1), "even": lambda: {"type": "constant"}, "sunsky": sunsky}


@pytest.mark.parametrize("body, light", [
    ("glass", "sun"), also("metal", "sun"), also("smooth", "sun"), ("glass", "even"), ("glass", "sunsky"),
])  # fmt: skip
def test_image_is_that_of_path(llvm, body, light):
    assert_image_of_path(scene_of(body, LIGHTS[light]()), only(), 64, SEEDS, Z_LIMIT)


TURNED = "sky.to_world", {"rotate": (0.6, 0, 0.8)}


@pytest.mark.parametrize("body, param, way, spp", [
    ("metal", *TURNED, 256),
    also("glass", *TURNED, 1024),
    also("metal", "body.bsdf.alpha.value", {"direction": 1.0}, 1024),
], ids=["metal-turned", "glass-turned", "metal-roughness"])  # fmt: skip
def test_derivative_is_that_of_camera_paths(llvm, body, param, way, spp):
    moved = perturb(scene_of(body, sky(0.1)), param, **way)
    ours = forward(moved, only(**INTERIOR), SEEDS, spp)
    theirs = forward(moved, {"type": "psdr_path", **LIMITS, **INTERIOR}, SEEDS, 2 * spp)
    assert_grad_close(ours, theirs)


def test_both_modes_agree(llvm):
    scene = scene_of("glass", sky(0.1))
    integrator = integrator_specs.build(only(**{**INTERIOR, "sppc": 4}))
    one, other, *norms = adjoint_identity(scene, "sky.to_world", integrator)
    assert abs(one - other) < TOLERANCE * np.prod(norms)


def test_skies_are_traced_where_a_sun_shines_on_what_is_rough(llvm):
    def light_of(body: str, light: dict):
        spec = {"type": "psdr_bdpt", **LIMITS, "form": "spatial", "sppc": 1, "sppp": 0, "sppi": 0}
        return make_plan(scene_of(body, light), "floor.to_world", integrator=spec).light

    assert light_of("glass", sky(SUN)).runs and light_of("metal", sky(SUN)).runs and light_of("glass", sunsky()).runs
    assert not light_of("smooth", sky(SUN)).runs
    assert not light_of("glass", sky(HAZE)).runs
    assert "as large as these" in light_of("glass", {"type": "constant"}).reason
    # Mitsuba draws its directions by another density than it says
    stretched = light_of("glass", sky(SUN, to_world=mi.ScalarTransform4f().scale([1, 2, 1])))
    assert not stretched.runs and "no light is of the kinds" in stretched.reason


def test_the_solid_angle_of_what_shines(llvm):
    """Of a Gaussian of width σ alone it is 4πσ²; an even sky has all directions."""
    def angle(light: dict) -> float:
        return sky_solid_angle(mi.load_dict({"type": "scene", "sky": light, "ball": {"type": "sphere"}}).emitters()[0])

    assert angle({"type": "constant"}) == pytest.approx(4 * np.pi)
    assert angle({"type": "constant", "radiance": 0.0}) == pytest.approx(4 * np.pi)
    assert angle(sky(SUN)) < LARGE < angle(sky(HAZE))
