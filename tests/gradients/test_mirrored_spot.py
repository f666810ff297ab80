"""Light of a spot by way of a plane mirror, on a receiver whose normals are interpolated between coarse faces.

What it shows is what the same spot behind the mirror shows without one, where light comes straight. Particles that come
by way of the mirror carry Veach's correction, which steps on every edge of the receiver, and what is seen steps where a
shading normal turns away from the camera. A hard rim of the cone moves with the spot and with the mirror.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, forward, mesh_of

from psdr_jit.derivative.perturbation import perturb

# what the mirror itself shows is in neither image
pytestmark = pytest.mark.filterwarnings("ignore:light of .lamp.", "ignore:shape .mirror.")

CELLS = 6  # along each side of the receiver
HEIGHT = 0.3  # of its waves [m]
PLACE, TARGET = np.array([0.3, 1.2, 0.3]), np.array([1.5, 0.75, 0.1])  # of the spot; the mirror is the plane x = 1.5
REFLECTANCE = 0.7
ABOVE, ASIDE = [0.0, 3.0, 0.5], [-2.6, 0.9, 0.5]  # the camera; from aside shading outlines are seen
SOFT, HARD = (22.0, 5.0), (14.0, 14.0)  # cone and beam of the spot [degrees]
SEEDS = 24
TOLERANCE = 1e-5  # of the adjoint identity
BLOCK = 4  # [px]


def receiver() -> mi.Mesh:
    ticks, n = np.linspace(-1, 1, CELLS + 1), CELLS + 1
    x, z = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    points = np.stack([x, HEIGHT * np.sin(3 * x) * np.cos(2 * z), z], -1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(CELLS), np.arange(CELLS), indexing="ij"))
    a, b, c, d = (u * n + v for u, v in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return mesh_of(points, faces, normals=True, bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}})


def scene(mirror: bool, eye: list[float], cone: tuple[float, float] = SOFT) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    t = mi.ScalarTransform4f()
    behind = np.array([1 if mirror else -1, 1, 1])
    place = PLACE * behind + [0 if mirror else 2 * TARGET[0], 0, 0]
    given = {
        "type": "scene", "receiver": receiver(),
        "lamp": {"type": "spot", "cutoff_angle": cone[0], "beam_width": cone[1],
                 "intensity": 5.0 * (REFLECTANCE if not mirror else 1),
                 "to_world": t.look_at(origin=place, target=TARGET, up=[0, 1, 0])},
        "camera": {"type": "perspective", "fov": 55, "film": film,
                   "to_world": t.look_at(origin=eye, target=[0, 0, 0], up=[0, 1, 0.02])},
    }  # fmt: skip
    if mirror:
        given["mirror"] = {
            "type": "rectangle", "to_world": t.translate([TARGET[0], 0, 0]).rotate([0, 1, 0], -90).scale(6),
            "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": REFLECTANCE},
        }  # fmt: skip
    return mi.load_dict(given)


def blocks(scene: mi.Scene, param: str, direction: tuple[float, ...], **spec) -> tuple[np.ndarray, np.ndarray]:
    """`(mean, standard error)` of the derivative, by blocks of the film."""
    d = forward(perturb(scene, param, direction), {"type": "psdr_path", "form": "spatial", **spec}, SEEDS, 128)
    d = d.reshape(SEEDS, 16 // BLOCK, BLOCK, 16 // BLOCK, BLOCK).mean((2, 4))
    return d.mean(0), d.std(0) / SEEDS**0.5


def assert_alike(mirrored: tuple, behind: tuple) -> None:
    size, error = np.abs(behind[0]).max(), np.hypot(mirrored[1], behind[1])
    assert error.max() < 0.1 * size, "too noisy to tell: what was left out is worth .4 of the largest block and more"
    assert np.abs(mirrored[0] - behind[0]).max() < 0.01 * size + 4 * error.max()


@pytest.mark.slow
@pytest.mark.parametrize(("eye", "direction"), [(ABOVE, (0.6, 0.6, 0.5)), (ASIDE, (1, 0, 0))])
def test_a_spot_in_a_mirror_is_one_behind_it(llvm, eye, direction):
    mirrored = blocks(scene(True, eye), "receiver.vertex_positions", direction, type="psdr_bdpt", max_depth=3)
    assert_alike(mirrored, blocks(scene(False, eye), "receiver.vertex_positions", direction, max_depth=2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("param", "direction", "of_image"),
    [("lamp.to_world", (0.5, 0.4, 0.3), (-0.5, 0.4, 0.3)), ("mirror.to_world", (1, 0, 0), (2, 0, 0))],
)
def test_a_hard_rim_moves_with_lamp_and_mirror(llvm, param, direction, of_image):
    mirrored = blocks(scene(True, ABOVE, HARD), param, direction, type="psdr_bdpt", max_depth=3)
    assert_alike(mirrored, blocks(scene(False, ABOVE, HARD), "lamp.to_world", of_image, max_depth=2))


def test_the_hard_rim_is_transposed(llvm):
    budgets = {"sppc": 0, "sppp": 0, "sppi": 0, "spps": 0, "sppd": 16}
    integrator = mi.load_dict({"type": "psdr_bdpt", "max_depth": 3, "form": "spatial", **budgets})
    wJv, JTwv, w, Jv = adjoint_identity(scene(True, ABOVE, HARD), "lamp.to_world", integrator)
    assert Jv > 0
    assert abs(wJv - JTwv) < TOLERANCE * w * Jv
