"""Receivers of lines, from which rays start at a height above the surface."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.lifted_receiver import Landing, lifted_receiver

RIM = 0.4  # of a sphere sunk into the floor
FROM = 0.05  # where the line has passed an edge, before it meets the floor


@pytest.fixture
def scene(llvm) -> mi.Scene:
    floor = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3)
    return mi.load_dict({
        "type": "scene", "floor": {"type": "rectangle", "to_world": floor},
        "ball": {"type": "sphere", "center": [0, -0.3, 0], "radius": 0.5},
    })  # fmt: skip


def received(scene: mi.Scene, x: float, ω: mi.Vector3f, passed: float = FROM):
    """The receiver of a line that meets the floor at x, on its way from an edge `passed` before."""
    edge = mi.Point3f(x, 0, 0) + passed * ω
    ray = mi.Ray3f(edge, -ω)
    job = SimpleNamespace(scene=scene, surfaces=None)
    met = Landing.of(job, ray, mi.Bool(True))
    assert dr.all(dr.abs(met.pi.t - passed) < 1e-5)
    return lifted_receiver(job, met, edge, mi.Bool(True))


@pytest.mark.parametrize(
    ("x", "towards_light", "found"),
    [(RIM + 1e-5, (-0.5, 1, 0), False), (RIM + 0.01, (-0.5, 1, 0), True), (RIM + 1e-5, (0.5, 1, 0), True),
     (1.5, (-1, 0.01, 0), True), (1.5, (-1, 0.005, 0), True)],
    ids=["beside the rim", "farther off", "away from it", "grazing", "grazing more"],
)  # fmt: skip
def test_the_rim_of_a_sphere(scene, x, towards_light, found):
    """A shadow next to where surfaces meet, thinner than the height, is not in the image. A line that grazes the floor
    far from the sphere has an ordinary one.
    """
    assert dr.all(received(scene, x, dr.normalize(mi.Vector3f(*towards_light)))[2] == found)


@pytest.mark.parametrize("slope", [0.0, 0.5, 2.0])
def test_the_ray_of_the_receiver_is_the_line(scene, slope):
    """Started as Mitsuba starts it."""
    ω = dr.normalize(mi.Vector3f(slope, 1, 0.3))
    receiver, above, found = received(scene, 1.5, ω)
    si = receiver.interaction()
    assert dr.all(found)
    start, offset = si.spawn_ray(ω).o, FROM - above
    assert np.allclose(start, np.array([[1.5], [0], [0]]) + np.array(above * ω), atol=1e-6)
    assert np.allclose(np.array(start + offset * ω), np.array([[1.5], [0], [0]]) + np.array(FROM * ω), atol=1e-6)


@pytest.mark.parametrize(("height", "blocks"), [(1e-4, False), (4e-4, True)])
def test_an_edge_below_the_height_blocks_nothing(scene, height, blocks):
    ω = dr.normalize(mi.Vector3f(0.5, 1, 0))
    assert dr.all(received(scene, 1.5, ω, height / ω.y)[2] == blocks)
