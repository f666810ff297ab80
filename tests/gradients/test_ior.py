"""The index of refraction of smooth glass and plastic, and what delta lobes are tinted with.

Closed forms: how much a plate reflects, and by how much it shifts what is seen through it.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import test_specular_chain
from helpers import adjoint_identity, assert_grad_close, fd, forward
from test_smooth_meshes import sphere
from test_specular import pane
from test_specular_chain import ball, behind_glass, camera

from psdr_jit import make_plan
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import gain

ETA, STEP = 1.5, 0.003
TOLERANCE = 0.02  # accepted error of a gain
PLATE, TILT = 0.5, 45.0  # thickness [m], angle to the line of sight [deg]
SIZE = 12  # of an image [px]
HALF = 0.25  # of the width of what is seen [m]
GLASS = {"type": "psdr_dielectric", "int_ior": ETA, "ext_ior": 1.0}
SMOOTH = {"sppc": 1, "sppp": 0, "sppi": 0}  # no edge is in view: what is smooth alone
ROUNDING = 0.001
ALBEDO = 0.6
RED_IS_BLACK = {"type": "rgb", "value": [0.0, 0.2, 0.5]}


def spec(depth: int, **budgets) -> dict:
    return {"type": "psdr_path", "max_depth": depth, "rr_depth": 1000, **budgets}


def parallel(half: float, pixels: str = "luminance") -> dict:
    """Looks down from z = 4 at a square of half the width `half`."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": pixels}
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    return {"type": "orthographic", "film": film, "to_world": pose @ mi.ScalarTransform4f().scale([half, half, 1])}


def fresnel(eta: float, cos: float) -> float:
    cos_t = np.sqrt(1 - (1 - cos**2) / eta**2)
    s, p = (cos - eta * cos_t) / (cos + eta * cos_t), (eta * cos - cos_t) / (eta * cos + cos_t)
    return (s**2 + p**2) / 2


def slope(f, at: float = ETA, h: float = 0.003):
    """Derivative of a function of η."""
    return (f(at + h) - f(at - h)) / (2 * h)


# ------------------------------------------------------------------------------------------ closed forms


def under_sky(bsdf: dict) -> mi.Scene:
    rectangle = {"type": "rectangle", "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "camera": parallel(0.5), "glass": rectangle, "sky": {"type": "constant"}},
                        optimize=False)  # fmt: skip


def coated(eta: float) -> float:
    """A diffuse base under a smooth coat, seen head-on: each crossing of the coat takes its share."""
    cos = (np.arange(4000) + 0.5) / 4000
    inside = float(mi.fresnel_diffuse_reflectance(mi.Float(1 / eta))[0])
    enters = np.mean(2 * cos * (1 - fresnel(eta, cos)))
    return fresnel(eta, 1.0) + ALBEDO / (1 - inside) * (1 - fresnel(eta, 1.0)) * enters / eta**2


REFLECTANCE = {  # of a surface that is met head-on, as a function of η
    "reflected": ({**GLASS, "specular_transmittance": 0.0}, lambda eta: ((eta - 1) / (eta + 1)) ** 2),
    "passed": ({**GLASS, "specular_reflectance": 0.0}, lambda eta: (1 - ((eta - 1) / (eta + 1)) ** 2) / eta**2),
    "plastic": ({**GLASS, "type": "psdr_plastic", "diffuse_reflectance": 0.0},
                lambda eta: ((eta - 1) / (eta + 1)) ** 2),
    "coat": ({**GLASS, "type": "psdr_plastic", "diffuse_reflectance": ALBEDO}, coated),
}  # fmt: skip


@pytest.mark.parametrize("case", REFLECTANCE)
def test_what_a_surface_shows_of_the_sky(llvm, case):
    bsdf, radiance = REFLECTANCE[case]
    estimate = forward(perturb(under_sky(bsdf), "glass.bsdf.eta"), spec(2, **SMOOTH), 8, 1024)
    exact = np.full(estimate.shape[1:], slope(radiance))
    assert_grad_close(estimate, exact, max_stderr=0.01, reference_stderr=ROUNDING)


def shift(eta: float) -> float:
    """How far behind the plate a ray is moved, in the direction of x."""
    sin, cos = np.sin(np.radians(TILT)), np.cos(np.radians(TILT))
    return -PLATE * sin * (1 - cos / np.sqrt(eta**2 - sin**2))


def transmittance(eta: float) -> float:
    return (1 - fresnel(eta, np.cos(np.radians(TILT)))) ** 2


def plate(background: dict) -> mi.Scene:
    pose = mi.ScalarTransform4f().rotate([0, 1, 0], TILT).scale([3, 3, PLATE / 2])
    glass = {"type": "cube", "to_world": pose, "bsdf": GLASS}
    return mi.load_dict({"type": "scene", "camera": parallel(HALF), "glass": glass, "background": background},
                        optimize=False)  # fmt: skip


def test_a_ramp_behind_a_tilted_plate(llvm):
    """Radiance that grows with x shows how far every ray is moved."""
    dark, bright, width = 0.2, 1.8, 1.2  # of the two texels, half a width apart
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.array([[[dark], [bright]]], np.float32)), "raw": True,
               "wrap_mode": "clamp"}  # fmt: skip
    middle = shift(ETA)
    pose = mi.ScalarTransform4f().translate([middle, 0, -2]).scale(width / 2)
    background = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": texture}}

    def row(eta: float) -> np.ndarray:
        x = HALF * (2 * np.arange(SIZE) + 1 - SIZE) / SIZE + shift(eta) - middle
        return transmittance(eta) * ((dark + bright) / 2 + (bright - dark) * x / (width / 2))

    estimate = forward(perturb(plate(background), "glass.bsdf.eta"), spec(3, **SMOOTH), 8, 256)
    exact = np.broadcast_to(slope(row)[None, :, None], estimate.shape[1:])
    assert_grad_close(estimate, exact, max_stderr=0.01, reference_stderr=ROUNDING)


@pytest.mark.slow
def test_an_edge_behind_a_tilted_plate(llvm):
    """The outline of a card moves with η: nothing but the lines across the film sees it."""
    edge = -0.15  # near the middle of the film
    pose = mi.ScalarTransform4f().translate([edge - 2, 0, -2]).scale(2)
    background = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area"}}
    estimate = forward(perturb(plate(background), "glass.bsdf.eta"), spec(3, sppc=0, sppi=0), 8, 128)
    brightness = estimate.sum((1, 2, 3)) * (2 * HALF / SIZE) ** 2
    expected = -slope(shift) * transmittance(ETA) * 2 * HALF
    value, error = brightness.mean(), brightness.std(ddof=1) / np.sqrt(len(brightness))
    assert error < 0.02 * abs(expected)
    assert abs(value - expected) < 0.005 * abs(expected) + 4 * error


# ------------------------------------------------------------------------------------------ finite differences


def with_ior(shape: str) -> dict | mi.Mesh:
    """A shape of `test_specular_chain` made of glass with a differentiable index."""
    if shape != "smooth_ball":
        return {**getattr(test_specular_chain, shape)(), "bsdf": GLASS}
    mesh = sphere(48, bsdf=GLASS)
    params = mi.traverse(mesh)
    params["vertex_positions"] = params["vertex_positions"] * 0.8
    params.update()
    return mesh


def assert_gain(motion: Perturbation, spec: dict, samples: tuple[int, int], reference: tuple[float, int, int]) -> None:
    """The gain against finite differences is 1, and known well enough to refuse 0, −g and g/2.

    `samples`: seeds of the estimate, and paths per pixel; `reference`: step of the differences, their seeds and paths.
    """
    images = fd(motion, spec, *reference)
    found = gain(forward(motion, spec, *samples), images[0::2], images[1::2])
    assert found.stderr < TOLERANCE, found
    assert abs(found.value - 1) < TOLERANCE + 2 * found.stderr, found


BEHIND = {"sppc": 1, "sppp": 0, "sppi": 0, "spps": 1}  # the sensor sees nothing but glass and a card
ON_A_WALL = {"sppc": 1, "sppp": 0, "sppd": 0, "sppi": 1, "spps": 0}  # and nothing but a wall that it lights
EVEN = {"sppc": 16, "sppp": 16, "sppi": 16, "spps": 16}


@pytest.mark.slow
def test_a_picture_behind_a_ball(llvm):
    motion = perturb(behind_glass(with_ior("ball")), "glass.bsdf.eta")
    assert_gain(motion, spec(6, **BEHIND), (8, 512), (STEP, 16, 4096))


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "seeds"), [("ball", 16), ("cube", 16), ("slab", 16), ("smooth_ball", 64)])
def test_a_picture_behind_glass(llvm, shape, seeds):
    """Few crossings of lines with the outline of the card, seen at the rim of a ball of facets, move very fast."""
    motion = perturb(behind_glass(with_ior(shape)), "glass.bsdf.eta")
    assert_gain(motion, spec(8, **BEHIND), (seeds, 1024), (STEP, 32, 16384))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_light_that_falls_through_glass_on_a_wall(llvm, shape):
    motion = perturb(pane(GLASS, shape), "glass.bsdf.eta")
    assert_gain(motion, spec(4, **ON_A_WALL), (16, 16384), (0.01, 64, 16384))


@pytest.mark.slow
def test_a_plastic_ball_under_a_lamp(llvm):
    plastic = {"type": "psdr_plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.3, 0.1]}}
    motion = perturb(lit_ball(plastic), "ball.bsdf.eta")
    assert_gain(motion, spec(4), (16, 1024), (0.02, 32, 16384))


def lit_ball(bsdf: dict) -> mi.Scene:
    T = mi.ScalarTransform4f()
    return mi.load_dict({
        "type": "scene", "camera": camera([0, 0.5, 4], [0, 0, 0], 40),
        "ball": {"type": "sphere", "bsdf": bsdf},
        "floor": {"type": "rectangle", "to_world": T.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)},
        "lamp": {"type": "rectangle", "to_world": T.translate([0, 3, 1]).rotate([1, 0, 0], 90).scale(0.8),
                 "emitter": {"type": "area", "radiance": 9.0}},
    }, optimize=False)  # fmt: skip


@pytest.mark.slow
def test_what_moves_behind_it_is_seen_as_behind_mitsubas_glass(llvm):
    """Same samples, same derivative."""
    images = []
    for bsdf in (GLASS, {**GLASS, "type": "dielectric"}):
        scene = behind_glass({**ball(), "bsdf": bsdf})
        images.append(forward(perturb(scene, "card.to_world", direction=(1, 0, 0)), spec(4, **BEHIND), 1, 16))
    assert np.abs(images[0] - images[1]).max() < 1e-4 * np.abs(images[1]).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("seen", ["directly", "by way of a wall"])
def test_backward_mode_is_the_adjoint(llvm, seen):
    scene = behind_glass(with_ior("ball")) if seen == "directly" else pane(GLASS, "sphere")
    forwards, backwards, w, jv = adjoint_identity(scene, "glass.bsdf.eta", integrator_specs.build(spec(6, **EVEN)))
    assert jv > 0 and abs(forwards - backwards) < 1e-5 * w * jv


def test_the_plan_knows_what_bends(llvm):
    """The index of glass moves what is seen through it, also by walls that are not black; that of plastic nothing."""
    glass = make_plan(behind_glass(ball() | {"bsdf": GLASS}), ["glass.bsdf.eta"], integrator=spec(6, **EVEN))
    assert {t.name for t in glass.running} == {"interior", "chain"}
    assert "no surface scatters" in glass.term("indirect").reason
    walled = make_plan(pane(GLASS, "sphere"), ["glass.bsdf.eta"], integrator=spec(6, **EVEN))
    assert {t.name for t in walled.running} >= {"interior", "chain", "indirect"} and not walled.term("primary").runs
    assert glass.form == "spatial"
    scene = lit_ball({"type": "psdr_plastic"})
    plastic = make_plan(scene, ["ball.bsdf.eta"], integrator=spec(6, **EVEN))
    assert [t.name for t in plastic.running] == ["interior"]


# ------------------------------------------------------------------------------------------ tints


def mirrors() -> mi.Scene:
    """Two mirrors, by which the camera sees the sky: the first takes all red, the second changes colours."""
    T = mi.ScalarTransform4f()
    tints = {"first": [0.0, 0.2, 0.5], "second": [0.3, 0.6, 0.9]}
    bsdfs = {n: {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": t}} for n, t in tints.items()}
    return mi.load_dict({
        "type": "scene", "camera": parallel(0.5, "rgb"), "sky": {"type": "constant"},
        "first": {"type": "rectangle", "to_world": T.rotate([0, 1, 0], 45), "bsdf": bsdfs["first"]},
        "second": {"type": "rectangle", "to_world": T.translate([2, 0, 0]).rotate([0, 1, 0], -45),
                   "bsdf": bsdfs["second"]},
    }, optimize=False)  # fmt: skip


TINTS = {"first": [0.3, 0.6, 0.9], "second": [0.0, 0.2, 0.5]}  # each one's derivative is the other's tint


@pytest.mark.parametrize("name", TINTS)
def test_a_tint_that_is_black_has_a_derivative(llvm, name):
    parameter = f"{name}.bsdf.specular_reflectance.value"
    image = forward(perturb(mirrors(), parameter), spec(4), 1, 16)
    assert np.allclose(image, TINTS[name], rtol=1e-4, atol=1e-6)
    assert not np.allclose(image / 2, TINTS[name], rtol=1e-4, atol=1e-6)
    forwards, backwards, w, jv = adjoint_identity(mirrors(), parameter, integrator_specs.build(spec(4)))
    assert jv > 0 and abs(forwards - backwards) < 1e-5 * w * jv


WEIGHTS = {
    "conductor": ({"type": "conductor", "material": "Cu"}, "eta.value"),
    "thindielectric": ({"type": "thindielectric", "specular_reflectance": RED_IS_BLACK}, "specular_reflectance.value"),
    "dielectric": ({"type": "dielectric", "specular_transmittance": 0.8}, "specular_transmittance.value"),
    "plastic": ({"type": "plastic", "specular_reflectance": 0.7}, "specular_reflectance.value"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", WEIGHTS)
def test_what_a_delta_lobe_is_worth(llvm, case):
    bsdf, name = WEIGHTS[case]
    assert_gain(perturb(lit_ball(bsdf), f"ball.bsdf.{name}"), spec(4), (16, 1024), (0.02, 32, 16384))
