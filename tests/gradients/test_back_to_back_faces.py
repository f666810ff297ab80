"""What lies on a face that turns away, next to the outline: less than rounding behind the face that hides it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from helpers import forward, mesh_of

from benchmarks import meshes
from psdr_jit.derivative.perturbation import perturb

SEGMENTS, SIDE, SEEDS, SPP = 200, 12, 8, 512
EYE, TARGET = np.array([0.9, 1.4, 5.2]), np.array([0.1, -0.2, 0.0])
SEEN_EDGES = 3.0  # width of the view

#: Of the largest pixel. Shading outlines on the hidden side were seen up to a fiftieth of an edge behind the outline:
#: pixels were 2.5 to 3.4 % off.
TOLERANCE = 0.002


def scene_of(points: np.ndarray, faces: np.ndarray, target: np.ndarray) -> mi.Scene:
    """A smooth-shaded body that shines, seen from close by."""
    body = mesh_of(points, faces, normals=True, emitter={"type": "area"})
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = mi.ScalarTransform4f().look_at(EYE.tolist(), target.tolist(), [0, 1, 0])
    edge = 2 * np.pi / SEGMENTS
    fov = np.degrees(SEEN_EDGES * edge / np.linalg.norm(target - EYE))
    sensor = {"type": "perspective", "fov": float(fov), "to_world": look, "film": film}
    return mi.load_dict({"type": "scene", "shape": body, "sensor": sensor}, optimize=False)


def derivative(points: np.ndarray, faces: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """As the body moves. (seeds, H, W)"""
    motion = perturb(scene_of(points, faces, spot), "shape.vertex_positions", (1, 0.4, 0))
    return forward(motion, {"type": "psdr_path", "max_depth": 1}, SEEDS, SPP)[..., 0]


def test_a_missing_face_on_the_far_side_changes_nothing(llvm):
    """Of a closed body that shines outwards only the outer side is looked at; of an open one, what rays meet."""
    points, faces = meshes.ball(SEGMENTS // 2, SEGMENTS)
    turn = mi.ScalarTransform4f().rotate([0.3, 0.2, 1], 23).rotate([1, 0.1, 0], 38)
    points = (points - meshes.CENTRE) / meshes.RADIUS @ np.array(turn.matrix)[:3, :3].T
    forwards = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    across = np.cross(forwards, [-0.6, 0.8, 0])
    spot = points[np.argmax(((points - EYE) @ across) / ((points - EYE) @ forwards))]
    farthest = int(np.argmax(points[faces[:, 0]] @ forwards))
    closed, opened = (derivative(points, f, spot) for f in (faces, np.delete(faces, farthest, axis=0)))
    off = np.abs(opened.mean(0) - closed.mean(0)).max() / np.abs(closed.mean(0)).max()
    error = closed.std(0, ddof=1).max() / np.sqrt(SEEDS) / np.abs(closed.mean(0)).max()
    assert off < TOLERANCE and error < TOLERANCE / 3
