"""Bodies of glass with sharp edges: rays start a small height off faces, and beside such an edge outside of the body.

Under a sky, a convex body shows what is mirrored in it and nothing else if paths end at their second vertex: no chain
sees a step, so the term is 0, exactly.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, mesh_of
from variants import activate

from psdr_jit.derivative.perturbation import perturb

FACES = np.array([(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)])
ALONE = dict.fromkeys(("sppc", "sppp", "sppd", "sppi"), 0)


def wedge(angle: float) -> mi.Mesh:
    """A prism along z, 1 long, two sides of which meet at this angle [degrees] and are as long, normals outward."""
    half = np.deg2rad(angle / 2)
    corners = np.array([(0, 0), (np.cos(half), np.sin(half)), (np.cos(half), -np.sin(half))])
    positions = np.array([(x - 0.5, y, z) for z in (0.5, -0.5) for x, y in corners])
    return mesh_of(positions, FACES, bsdf={"type": "dielectric"}, face_normals=True)


def scene(angle: float) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[-0.5, 3, 0.8], target=[0, 0, 0], up=[1, 0, 0])
    return mi.load_dict({
        "type": "scene", "wedge": wedge(angle), "sky": {"type": "constant"},
        "camera": {"type": "perspective", "fov": 30, "film": film, "to_world": pose},
    })  # fmt: skip


@pytest.mark.parametrize("angle", [15.0, 40.0])
def test_no_light_leaks_through_sharp_edges(llvm, angle):
    motion = perturb(scene(angle), "wedge.vertex_positions", (1, 0.3, 0.2))
    spec = {"type": "psdr_path", "max_depth": 2, "form": "spatial"}
    chain, whole = (forward(motion, {**spec, **budgets}, 2, 64) for budgets in ({**ALONE, "spps": 64}, {}))
    assert np.abs(whole).max() > 1, "nothing to be seen that could be wrong"
    assert np.abs(chain).max() < 1e-3 * np.abs(whole).max()


def test_every_direction_of_a_constant_sky_is_alike_in_a_wedge(llvm):
    """Paths of any length bring the same light from everywhere, so nothing steps; leaks past the sharp edge would."""
    motion = perturb(scene(40.0), "wedge.vertex_positions", (1, 0.3, 0.2))
    spec = {"type": "psdr_path", "form": "spatial", "rr_depth": 1000, **ALONE, "spps": 64}
    cut_short, whole = (forward(motion, {**spec, "max_depth": depth}, 8, 64) for depth in (3, 20))
    assert abs(whole.sum()) < 0.1 * abs(cut_short.sum()), "leaks brought half of it"


def test_a_wedge_in_spectral_rendering():
    activate("llvm_ad_spectral")
    motion = perturb(scene(40.0), "wedge.vertex_positions", (1, 0.3, 0.2))
    chain = forward(motion, {"type": "psdr_path", "form": "spatial", "max_depth": 3, **ALONE, "spps": 16}, 2, 16)
    assert np.abs(chain).max() > 1, "nothing was crossed"
