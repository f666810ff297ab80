"""Terms against answers that can be written down: half-planes, head-on lights, spheres, lamps, a furnace."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import assert_grad_close, forward, load, spec_of
from problems import Problem

from psdr_jit.derivative.perturbation import perturb

RADIANCE = np.array([1.0, 0.8, 0.6])  # of the glowing things in these scenes
SKY = np.array([0.25, 0.5, 0.75])  # behind half_plane.xml
FRAME = 2.0  # width of the frame at z = 0 [scene units]
ROUNDING = 1e-3  # of estimates whose samples do not scatter


def scene_of(name: str, **defaults) -> mi.Scene:
    return load(Problem(name, "", 0.0), **defaults)


def estimate(scene, param, seeds=8, spp=16, term=None, options=None, **how) -> np.ndarray:
    return forward(perturb(scene, param, **how), spec_of(scene, term, **(options or {})), seeds, spp)


def gaussian(x: np.ndarray) -> np.ndarray:
    """Mitsuba's default `gaussian` filter: standard deviation 0.5 px, cut off at 2 px and lowered to 0 there."""
    return np.maximum(np.exp(-2 * x**2) - np.exp(-8.0), 0) * (np.abs(x) < 2)


def filtered_edge(edge: float, width: int, border: bool) -> np.ndarray:
    """f(edge − x_i) / ∫ f over the sampled film, per pixel column: derivative of a step at `edge` [px]."""
    lower, upper = (-2, width + 2) if border else (0, width)
    x = np.arange(lower, upper, 1 / 512) + 1 / 1024
    centre = np.arange(width) + 0.5
    mass = gaussian(x[None, :] - centre[:, None]).sum(1) / 512
    return gaussian(edge - centre) / mass


@pytest.mark.parametrize("rfilter, border", [("box", False), ("gaussian", False), ("gaussian", True)])
@pytest.mark.parametrize("edge", [0.0625, -0.965, 0.99])
def test_half_plane(variant, rfilter, border, edge):
    """A vertical edge that moves to the right by dx turns (L₊ − L₋) dx of each row from sky into plane.

    The edge lies in the middle of the image, and within half a pixel of either side of the film.
    """
    res = 16
    scene = scene_of("half_plane", rfilter=rfilter, sample_border=str(border).lower())
    params = mi.traverse(scene)
    shift = edge - 0.0625
    vertices = np.array(params["plane.vertex_positions"]).reshape(-1, 3) + np.array([shift, 0, 0])
    params["plane.vertex_positions"] = vertices.ravel()
    params.update()
    image = estimate(scene, "plane.vertex_positions", direction=(1, 0, 0))

    x = (edge + FRAME / 2) / FRAME * res  # [px]
    column = np.zeros(res)
    column[int(x)] = 1
    if rfilter == "gaussian":
        column = filtered_edge(x, res, border)
    exact = (RADIANCE - SKY) * (column * res / FRAME)[None, :, None] * np.ones((res, 1, 1))
    assert_grad_close(image, exact, reference_stderr=ROUNDING)
    assert np.abs(image.mean(0) - exact).max() < 0.02 * np.abs(exact).max()


def total_light(images: np.ndarray) -> np.ndarray:
    """Integral over the plane z = 0 of each image, as an image of one pixel."""
    pixel = (FRAME / images.shape[1]) ** 2
    return images.sum((1, 2), keepdims=True) * pixel


def test_head_on_light_grows(variant):
    """∫ L = radiance · width · height; width and height grow by their own rates."""
    scene = scene_of("emitter_scale")
    vertices = np.array(mi.traverse(scene)["square.vertex_positions"]).reshape(-1, 3)
    centred = vertices - vertices.mean(0)
    width, height = np.ptp(vertices[:, 0]), np.ptp(vertices[:, 1])
    rates = centred * np.array([0.5, -2.0, 0])  # d width = 0.5 width, d height = −2 height
    image = estimate(scene, "square.vertex_positions", direction=rates.ravel())
    exact = RADIANCE * width * height * (0.5 - 2.0)
    assert_grad_close(total_light(image), exact.reshape(1, 1, 3), reference_stderr=2 * ROUNDING)


def test_sphere_silhouette_grows(variant):
    """From distance D a sphere of radius r covers a disc of radius R = rD/√(D² − r²) of the plane through its centre.

    dR/dr = D³/(D² − r²)^{3/2}; the light in the frame is radiance · πR².
    """
    scene, r, D = scene_of("glowing_sphere"), 0.5, 4.0
    params = mi.traverse(scene)
    motion = perturb(scene, "ball.to_world", (1, 0, 0))
    base = mi.Transform4f(params["ball.to_world"])
    object.__setattr__(motion, "curve", lambda dr_: base @ mi.Transform4f().scale((r + dr_) / r))
    image = forward(motion, spec_of(scene), 8, 16)
    R, dR = r * D / np.sqrt(D**2 - r**2), D**3 / (D**2 - r**2) ** 1.5
    exact = RADIANCE * 2 * np.pi * R * dR
    assert_grad_close(total_light(image), exact.reshape(1, 1, 3), reference_stderr=2 * ROUNDING)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_lamp_over_a_plane(variant, axis):
    """A diffuse plane under a point light at (l, h): ρ/π · I h/(h² + |x − l|²)^{3/2}, differentiated by (l, h)."""
    res, lamp, rho, intensity = 16, np.array([0.3, -0.2, 0.8]), 0.6, 2.0
    T = mi.ScalarTransform4f
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2, "rr_depth": 1000},
        "camera": {
            "type": "orthographic",
            "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": res, "height": res, "rfilter": {"type": "box"},
                     "pixel_format": "rgb"},
        },
        "plane": {"type": "rectangle", "to_world": T().scale(5), "bsdf": {"type": "diffuse", "reflectance": rho}},
        "lamp": {"type": "point", "position": lamp.tolist(), "intensity": intensity},
    }, optimize=False)  # fmt: skip
    image = estimate(scene, "lamp.position", spp=64, direction=np.eye(3)[axis])

    fine = (np.arange(8 * res) + 0.5) / (8 * res) * FRAME - FRAME / 2
    x, y = np.meshgrid(fine, -fine)  # the first row of an image is its top
    offset = np.stack([lamp[0] - x, lamp[1] - y, np.full_like(x, lamp[2])])
    d2 = (offset**2).sum(0)
    h = lamp[2]
    gradient = -3 * h * offset / d2**2.5
    gradient[2] += d2**-1.5
    exact = (rho / np.pi * intensity * gradient[axis]).reshape(res, 8, res, 8).mean((1, 3))
    assert_grad_close(image, np.repeat(exact[..., None], 3, axis=2), reference_stderr=ROUNDING)


@pytest.mark.parametrize("gap", [0.2, 0.02])
def test_a_glowing_sphere_close_to_a_plane(variant, gap):
    """Beneath a sphere of radius r at the distance d a diffuse plane has ρ L r²/d². Rays start a height above it."""
    r, rho, radiance = 0.4, 0.5, 10.0
    d = r + gap
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    grazing = T().look_at([-0.3, 0, 0.05], [0, 0, 0], [0, 0, 1]).scale([1e-3, 1e-3, 1])
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "orthographic", "to_world": grazing, "film": film},
        "plane": {"type": "rectangle", "to_world": T().scale(0.05), "bsdf": {"type": "diffuse", "reflectance": rho}},
        "lamp": {"type": "sphere", "center": [0, 0, d], "radius": r, "emitter": {"type": "area", "radiance": radiance}},
    }, optimize=False)  # fmt: skip
    image = estimate(scene, "lamp.to_world", spp=2048, direction=(0, 0, 1))
    assert_grad_close(image, np.full(image.shape[1:], -2 * rho * radiance * r**2 / d**3), reference_stderr=2 * ROUNDING)


@pytest.mark.parametrize("param, derivative", [
    ("walls.bsdf.reflectance.value", lambda E, a: E / (1 - a) ** 2),
    ("walls.emitter.radiance.value", lambda E, a: 1 / (1 - a)),
], ids=["albedo", "radiance"])  # fmt: skip
@pytest.mark.parametrize("rr_depth", [3, 1000])
def test_furnace(variant, param, derivative, rr_depth):
    """In a closed room of albedo a and emission E, L = E/(1 − a) everywhere: the series of all bounces."""
    albedo = np.array([0.5, 0.4, 0.3])
    depth = -1 if rr_depth == 3 else 24  # 0.5^24 is far below the rounding
    image = estimate(scene_of("furnace"), param, options=dict(rr_depth=rr_depth, max_depth=depth))
    exact = np.broadcast_to(derivative(RADIANCE, albedo), image.shape[1:])
    assert_grad_close(image, exact, reference_stderr=ROUNDING)
    assert np.abs(image.mean(0).mean((0, 1)) / exact[0, 0] - 1).max() < 0.01


def test_nothing_moves_in_a_furnace(variant):
    """A legitimately zero derivative: the camera moves inside the furnace, and every image is the same constant.

    The bound is absolute: 2 % of the image per unit of length, on the mean of 4 × 4 pixel blocks.
    """
    scene = scene_of("furnace")
    options = dict(max_depth=12, rr_depth=1000)
    image = estimate(scene, "camera.to_world", seeds=32, direction=(1, 0, 0), term="primary", options=options)
    blocks = image.mean(0).reshape(4, 4, 4, 4, 3).mean((1, 3))
    level = (RADIANCE / (1 - np.array([0.5, 0.4, 0.3]))).max()
    assert np.abs(blocks).max() < 0.02 * level
