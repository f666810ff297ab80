"""Steps that a light throws on a plane, against what can be written down: each slides along as the light does."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, mean_and_error

from psdr_jit.derivative.perturbation import perturb

RES, ALBEDO, HEIGHT = 16, 0.6, 2.0  # of the image [px], of the floor, of the light above it
PIXEL = 2 / RES  # width on the floor, of which the square [−1, 1]² is seen


def scene_of(light: dict) -> mi.Scene:
    """A floor seen from above, and a light above it that shines straight down."""
    film = {"type": "hdrfilm", "width": RES, "height": RES, "rfilter": {"type": "box"}, "pixel_format": "luminance",
            "component_format": "float32"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, HEIGHT], target=[0, 0, 0], up=[0, 1, 0])
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": ALBEDO},
             "to_world": mi.ScalarTransform4f().scale(3)}  # fmt: skip
    return mi.load_dict({"type": "scene", "camera": {"type": "orthographic", "to_world": view, "film": film},
                         "floor": floor, "light": {**light, "to_world": pose}}, optimize=False)  # fmt: skip


def columns(scene: mi.Scene, spp: int, param: str = "light.to_world", direction=(1, 0, 0)) -> tuple:
    """Derivative of ∫ radiance over each column of pixels, by x: `(mean, standard error)`."""
    images = forward(perturb(scene, param, direction), {"type": "psdr_path", "max_depth": 2}, 8, spp)[..., 0]
    return mean_and_error(images.sum(1) * PIXEL**2)


def shifted(profile, borders: np.ndarray) -> np.ndarray:
    """Derivative of the integral over each column as `profile`, the integral along y, moves to +x."""
    return profile(borders[:-1]) - profile(borders[1:])


BORDERS = np.linspace(-1, 1, RES + 1)


@pytest.mark.parametrize("angle", [10.0, 20.0])
def test_a_hard_spot_moved_sideways(variant, angle):
    """E = I h / (h² + x² + y²)^(3/2) within the circle of radius h tan θ, integrated along y."""
    light = {"type": "spot", "cutoff_angle": angle, "beam_width": angle, "intensity": 3.0}

    def profile(x):
        radius = HEIGHT * np.tan(np.deg2rad(angle))
        half = np.sqrt(np.maximum(radius**2 - x**2, 0))
        return ALBEDO / np.pi * 3 * HEIGHT * 2 * half / ((HEIGHT**2 + x**2) * np.hypot(HEIGHT, radius))

    exact, (found, error) = shifted(profile, BORDERS), columns(scene_of(light), 64)
    assert np.abs(exact).max() > 40 * error.max()  # 0, or half of it, would be seen
    assert (np.abs(found - exact) < 6 * error + 1e-3 * np.abs(exact).max()).all(), (found - exact) / error
    assert abs(found.sum()) < 6 * np.linalg.norm(error) + 1e-3 * np.abs(exact).max()  # all of the light stays in view


def test_the_opening_of_a_hard_spot(variant):
    """dR/dθ = h / cos²θ times the light at the rim. The cone and the beam widen together, each does half of it."""
    angle, wider = 20.0, np.deg2rad(1)
    rim = HEIGHT / np.cos(np.deg2rad(angle))
    exact = ALBEDO / np.pi * 3 * HEIGHT / rim**3 * 2 * np.pi * HEIGHT * np.tan(np.deg2rad(angle)) * rim**2 / HEIGHT
    for name in ("cutoff_angle", "beam_width"):
        scene = scene_of({"type": "spot", "cutoff_angle": angle, "beam_width": angle, "intensity": 3.0})
        found, error = columns(scene, 32, f"light.{name}", 1.0)
        assert np.linalg.norm(error) < 0.02 * exact * wider
        assert abs(found.sum() / (exact * wider / 2) - 1) < 0.01 + 6 * np.linalg.norm(error) / (exact * wider)


@pytest.mark.parametrize("picture", ["frame", "stripes"])
def test_a_picture_moved_sideways(variant, picture):
    """A projector lights a plane in front of it evenly, E = π p / h², p its picture: a step function of x."""
    texels = np.array([1.0, 1.0]) if picture == "frame" else np.array([0.2, 1.0, 0.0, 0.7, 0.7])
    data = np.broadcast_to(texels[:, None], (1, len(texels), 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(data, 2, 0)), "raw": True, "filter_type": "nearest"}
    scene = scene_of({"type": "projector", "irradiance": bitmap, "fov": 38.0})
    half = HEIGHT * np.tan(np.deg2rad(38 / 2))
    height = 2 * half * 2 / len(texels)
    steps = np.diff(np.concatenate([[0], texels, [0]])) * ALBEDO / np.pi * np.pi / HEIGHT**2 * min(height, 2)
    places = np.linspace(-half, half, len(steps))
    exact = np.zeros(RES)
    np.add.at(exact, np.searchsorted(BORDERS, places) - 1, -steps)
    found, error = columns(scene, 32)
    assert np.abs(exact).max() > 40 * error.max()
    assert (np.abs(found - exact) < 6 * error + 1e-3 * np.abs(exact).max()).all(), (found, exact)
