"""Outlines that fold within less than a thousandth of a mesh's size: what lies beside them is the next fold."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from helpers import forward

from psdr_jit.derivative.perturbation import perturb

#: Blocks of 4 x 4 pixels of the tube below, by visibility in double precision of 400 points on each edge.
EXACT = np.array([0.7017, -0.9951, 0.8735, -0.6066])
SEGMENTS, TWIST = 64, 0.3


def twisted_tube() -> mi.Mesh:
    """Open; thin triangles between two rings, of which one is turned."""
    a, i = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False), np.arange(SEGMENTS)
    both = ((0.5, 0, 0.1), (0.3, TWIST, 1.3))  # radius, turn, height
    rings = [(r * np.cos(a + turn), 0 * a + y, r * np.sin(a + turn)) for r, turn, y in both]
    points, j = np.concatenate([np.stack(ring, 1) for ring in rings]), (i + 1) % SEGMENTS
    faces = np.concatenate([np.stack([i, SEGMENTS + i, j], 1), np.stack([j, SEGMENTS + i, SEGMENTS + j], 1)])
    props = mi.Properties()
    props["bsdf"], props["face_normals"] = mi.load_dict({"type": "diffuse", "reflectance": 0.0}), True
    mesh = mi.Mesh("tube", len(points), len(faces), props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def test_a_twisted_tube_before_a_bright_sky(llvm):
    """Looked past at the height at which Mitsuba starts rays, blocks were up to 14 % too large."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = mi.ScalarTransform4f().look_at([0, 2, 5], [0, 0.6, 0], [0, 1, 0])
    scene = mi.load_dict({"type": "scene", "tube": twisted_tube(), "sky": {"type": "constant"},
                          "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film}},
                         optimize=False)  # fmt: skip
    motion = perturb(scene, "tube.vertex_positions", (1, 0.3, 0))
    images = forward(motion, {"type": "psdr_path", "max_depth": 2}, 4, 1024)
    found = images.mean(0).reshape(4, 4, 4, 4).mean((1, 3))[1:3, 1:3].ravel()
    assert np.abs(found - EXACT).max() < 0.015
