"""What counts as close by: within reach, and on the side on which the path goes on."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.sensor_frame import sensor_frame, view_width
from psdr_jit.paths.close_by import REACH, CloseBy

FAR = 4.0  # distance of the sensor [m]


def sensor(kind: str = "perspective", scale: float = 1.0) -> dict:
    """Above the origin; what it shows at the height 0 is 4 wide."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    pose = T().look_at(origin=(0, 0, FAR), target=(0, 0, 0), up=(0, 1, 0))
    if kind == "orthographic":
        return {"type": kind, "to_world": pose @ T().scale((2 * scale, 2 * scale, 1)), "film": film}
    return {"type": kind, "to_world": pose, "fov": 2 * np.degrees(np.arctan(0.5 * scale)), "film": film}


def room(kind: str = "perspective", scale: float = 1.0) -> mi.Scene:
    """A floor with a wall at x = 1, and a board above it at half of the reach, for x < -1."""
    T = mi.ScalarTransform4f
    wall = T().translate((1, 0, 0)).rotate((0, 1, 0), -90).scale(3)
    board = T().translate((-2, 0, REACH * FAR / 2)).scale((1, 3, 1))
    return mi.load_dict({
        "type": "scene",
        "sensor": sensor(kind, scale),
        "floor": {"type": "rectangle", "to_world": T().scale(3)},
        "wall": {"type": "rectangle", "to_world": wall},
        "board": {"type": "rectangle", "to_world": board},
    })  # fmt: skip


def found(scene: mi.Scene, x: float, up: float = 1.0) -> bool:
    """Is anything close by the point (x, 0) of the floor, as seen from above or below?"""
    ray = mi.Ray3f(mi.Point3f(x, 0.1, up * 1e-3), mi.Vector3f(0, 0, -up))
    si = scene.ray_intersect(ray)
    close_by = CloseBy(scene, sensor_frame(scene.sensors()[0]))
    return bool(close_by.has(si, dr.normalize(mi.Vector3f(-0.3, 0.2, up)), si.is_valid())[0])


@pytest.mark.parametrize(
    ("x", "up", "said"),
    [(0.0, 1, False), (1 - 0.5 * REACH * FAR, 1, True), (1 - 2 * REACH * FAR, 1, False),
     (-2.0, 1, True), (-2.0, -1, False), (1 + 0.5 * REACH * FAR, 1, True)],
    ids=["open", "corner", "beyond reach", "gap", "other side", "behind the wall"],
)  # fmt: skip
def test_within_reach_and_on_that_side(llvm, x, up, said):
    assert found(room(), x, up) == said


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_the_reach_goes_by_what_the_film_shows(llvm, kind, scale):
    scene = room(kind, scale)
    width = view_width(sensor_frame(scene.sensors()[0]), mi.Point3f(0))
    assert np.allclose(width, FAR * scale, rtol=1e-4)
    assert found(scene, 1 - 0.5 * REACH * FAR * scale) and not found(scene, 1 - 1.5 * REACH * FAR * scale)
