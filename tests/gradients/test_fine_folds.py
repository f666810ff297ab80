"""Outlines of finely tessellated meshes: what lies beside them is the next fold, and faces are seen all but edge-on."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import forward, mesh_of
from variants import also

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


SIDE, FOV, DISTANCE = 12, 28.0, 5.0
MOTION = np.array([1.0, 0.3, -0.4])


def fine_ball(rings: int, around: int, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed, of quads cut in two; positions as files have them, with six digits."""
    a, b = np.meshgrid(np.linspace(0, np.pi, rings + 1)[1:-1], np.linspace(0, 2 * np.pi, around, endpoint=False),
                       indexing="ij")  # fmt: skip
    points = np.stack([np.sin(a) * np.cos(b), np.cos(a), np.sin(a) * np.sin(b)], -1).reshape(-1, 3)
    points = np.round(np.concatenate([points, [[0, 1, 0], [0, -1, 0]]]) @ turned.T, 6)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rings - 2), np.arange(around), indexing="ij"))
    at = lambda ring, k: ring * around + k % around  # noqa: E731
    quads = [(at(i, j), at(i, j + 1), at(i + 1, j)), (at(i, j + 1), at(i + 1, j + 1), at(i + 1, j))]
    k, top = np.arange(around), np.full(around, len(points) - 2)
    caps = [(top, at(0, k + 1), at(0, k)), (top + 1, at(rings - 2, k), at(rings - 2, k + 1))]
    return points, np.concatenate([np.stack(corners, 1) for corners in (*quads, *caps)])


def outline_on_film(points: np.ndarray, faces: np.ndarray, eye: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Derivative of the image, 1 beside the body and 0 on it, from its outline in double precision."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    front = np.einsum("ij,ij->i", np.cross(b - a, c - a), eye - a) > 0
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner, key = np.tile(np.arange(len(faces)), 3), np.sort(sides, axis=1)
    order = np.lexsort(key.T)
    one, two = order[::2], order[1::2]  # every edge has two faces
    assert (key[one] == key[two]).all()
    turns = front[owner[one]] != front[owner[two]]
    edge = np.where(front[owner[one]], one, two)[turns]  # as the front face goes round it: the body is on its left
    t = (np.arange(64) + 0.5) / 64
    p, q = points[sides[edge, 0]], points[sides[edge, 1]]
    scale = SIDE / 2 / np.tan(np.radians(FOV / 2))

    def film(x: np.ndarray) -> np.ndarray:
        local = (x - eye) @ frame.T
        return SIDE / 2 + scale * local[..., :2] / local[..., 2:]

    x = p[:, None] + t[:, None] * (q - p)[:, None]
    at, speed = film(x), (film(x + 1e-6 * MOTION) - film(x - 1e-6 * MOTION)) / 2e-6
    along = (film(q) - film(p))[:, None] / len(t)
    lost = along[..., 1] * speed[..., 0] - along[..., 0] * speed[..., 1]
    image = np.zeros((SIDE, SIDE))
    np.add.at(image, (at[..., 1].astype(int), at[..., 0].astype(int)), lost)
    return image


@pytest.mark.parametrize("seed", [0, also(1), also(2)])
def test_a_fine_ball_before_a_bright_sky(llvm, seed):
    """A third of a quad that was seen all but edge-on was taken for hidden: 5 % of a pixel."""
    turned, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    points, faces = fine_ball(128, 256, turned * np.sign(np.linalg.det(turned)))
    points = points.astype(np.float32).astype(float)
    eye = np.array([0.3, 0.2, DISTANCE])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = mi.ScalarTransform4f().look_at(list(eye), [0, 0, 0], [0, 1, 0])
    ball = mesh_of(points, faces, bsdf=mi.load_dict({"type": "diffuse", "reflectance": 0.0}))
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "constant"},
                          "sensor": {"type": "perspective", "fov": FOV, "to_world": look, "film": film}},
                         optimize=False)  # fmt: skip
    axes = np.array(look.matrix)[:3, :3].T
    exact = outline_on_film(points, faces, eye, np.stack([-axes[0], -axes[1], axes[2]]))
    motion = perturb(scene, "ball.vertex_positions", tuple(MOTION))
    found = forward(motion, {"type": "psdr_path", "max_depth": 1}, 4, 4096).mean(0)[..., 0]
    assert np.abs(found - exact).max() < 0.01 * np.abs(exact).max()
