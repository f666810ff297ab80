"""Shadows next to where surfaces meet, thinner than the height at which rays start."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from psdr_jit.boundary.direct import thinner_than_lift

RIM = 0.4  # of a sphere sunk into the floor


@pytest.fixture
def scene(llvm) -> mi.Scene:
    floor = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3)
    return mi.load_dict({
        "type": "scene", "floor": {"type": "rectangle", "to_world": floor},
        "ball": {"type": "sphere", "center": [0, -0.3, 0], "radius": 0.5},
    })  # fmt: skip


@pytest.mark.parametrize(
    ("x", "towards_light", "thin"),
    [(RIM + 1e-5, (-0.5, 1, 0), True), (RIM + 0.01, (-0.5, 1, 0), False), (RIM + 1e-5, (0.5, 1, 0), False),
     (1.5, (-1, 0.01, 0), False), (1.5, (-1, 0.001, 0), False)],
    ids=["beside the rim", "farther off", "away from it", "grazing", "grazing more"],
)  # fmt: skip
def test_the_rim_of_a_sphere(scene, x, towards_light, thin):
    """A line that grazes the floor far from the sphere has an ordinary shadow."""
    ω = dr.normalize(mi.Vector3f(*towards_light))
    ray = mi.Ray3f(mi.Point3f(x, 0, 0) + 0.05 * ω, -ω)
    hit = scene.ray_intersect_preliminary(ray)
    assert dr.all(dr.abs(hit.t - 0.05) < 1e-5)
    assert dr.all(thinner_than_lift(scene, None, hit, ray, mi.Bool(True)) == thin)
