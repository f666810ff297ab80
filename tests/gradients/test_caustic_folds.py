"""Light of a spot by way of a plane mirror, on a receiver whose normals are interpolated between coarse faces.

What it shows is what the same spot behind the mirror shows without one, where light comes straight. Particles that come
by way of the mirror carry Veach's correction, which steps on every edge of the receiver, and what is seen steps where a
shading normal turns away from the camera.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, mesh_of

from psdr_jit.derivative.perturbation import perturb

pytestmark = pytest.mark.filterwarnings("ignore:light of .lamp.")

CELLS = 6  # along each side of the receiver
HEIGHT = 0.3  # of its waves [m]
PLACE, TARGET = np.array([0.3, 1.2, 0.3]), np.array([1.5, 0.75, 0.1])  # of the spot; the mirror is the plane x = 1.5
REFLECTANCE = 0.7
ABOVE, ASIDE = [0.0, 3.0, 0.5], [-2.6, 0.9, 0.5]  # the camera; from aside shading outlines are seen
SEEDS = 24
BLOCK = 4  # [px]


def receiver() -> mi.Mesh:
    ticks, n = np.linspace(-1, 1, CELLS + 1), CELLS + 1
    x, z = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    points = np.stack([x, HEIGHT * np.sin(3 * x) * np.cos(2 * z), z], -1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(CELLS), np.arange(CELLS), indexing="ij"))
    a, b, c, d = (u * n + v for u, v in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return mesh_of(points, faces, normals=True, bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}})


def scene(mirror: bool, eye: list[float]) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    t = mi.ScalarTransform4f()
    behind = np.array([1 if mirror else -1, 1, 1])
    place = PLACE * behind + [0 if mirror else 2 * TARGET[0], 0, 0]
    given = {
        "type": "scene", "receiver": receiver(),
        "lamp": {"type": "spot", "cutoff_angle": 22, "beam_width": 5,
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


@pytest.mark.parametrize(("eye", "direction"), [(ABOVE, (0.6, 0.6, 0.5)), (ASIDE, (1, 0, 0))])
def test_a_spot_in_a_mirror_is_one_behind_it(llvm, eye, direction):
    found = []
    for mirror in (True, False):
        motion = perturb(scene(mirror, eye), "receiver.vertex_positions", direction)
        spec = {"type": "psdr_bdpt" if mirror else "psdr_path", "max_depth": 3 if mirror else 2}
        d = forward(motion, spec, SEEDS, 128)
        found.append(d.reshape(SEEDS, 16 // BLOCK, BLOCK, 16 // BLOCK, BLOCK).mean((2, 4)))
    means, errors = zip(*((d.mean(0), d.std(0) / SEEDS**0.5) for d in found), strict=True)
    size, error = np.abs(means[1]).max(), np.hypot(*errors)
    assert error.max() < 0.1 * size, "too noisy to tell: without folds and outlines, blocks are off by .4 and more"
    assert np.abs(means[0] - means[1]).max() < 0.01 * size + 4 * error.max()
