"""Ellipsoids: their geometry, and what is said about those that cut into each other."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit import make_plan
from psdr_jit.core.ellipsoid import Ellipsoid
from psdr_jit.errors import UnsupportedWarning

EYE = (0.3, -6, 1)
EXTENT = 2.0
QUATERNIONS = [[0.2, 0.1, 0.3, 0.9], [0.5, 0.5, 0.5, 0.5]]  # the first is not of unit length


def scene_of(*centres: tuple[float, float, float]) -> mi.Scene:
    tensors = {"centers": list(centres), "scales": [[0.3, 0.15, 0.1], [0.1, 0.2, 0.3]], "quaternions": QUATERNIONS}
    bodies = {"type": "ellipsoids", "extent": EXTENT, **{k: mi.TensorXf(np.float32(v)) for k, v in tensors.items()}}
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    pose = mi.ScalarTransform4f().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    lamp = {"type": "point", "position": [1.5, -2.5, 4]}
    return mi.load_dict({"type": "scene", "camera": camera, "lamp": lamp, "bodies": bodies}, optimize=False)


APART = (-0.9, 0, 0.1), (0.7, 0.2, 0.3)


def bodies_of(scene: mi.Scene, index: mi.UInt32) -> Ellipsoid:
    data = mi.traverse(scene)["bodies.data"]
    return Ellipsoid.of([dr.gather(mi.Float, data, index * 10 + k) for k in range(10)], mi.Float(EXTENT))


def test_outlines_are_where_mitsuba_ceases_to_meet_them(llvm):
    scene, t = scene_of(*APART), dr.linspace(mi.Float, 0, 1, 64)
    for k in range(2):
        body = bodies_of(scene, mi.UInt32(k))
        m, dm, valid = body.outline(mi.Vector4f(*EYE, 1), t)
        x, n = body.point(m), body.normal(m)
        towards = dr.normalize(mi.Point3f(*EYE) - x)
        assert dr.all(valid) and dr.all(dr.abs(dr.dot(n, towards)) < 1e-4)
        assert dr.all(dr.abs(dr.dot(n, body.vector(dm))) < 1e-4)
        for off, met in ((-5e-3, True), (5e-3, False)):
            ray = mi.Ray3f(mi.Point3f(*EYE), dr.normalize(x + off * n - mi.Point3f(*EYE)))
            assert dr.all(scene.ray_test(ray) == met)


@pytest.mark.parametrize(("centres", "touch"), [(APART, False), ((APART[0], (-0.8, 0, 0.1)), True)])
def test_those_that_cut_into_each_other_are_named(llvm, recwarn, centres, touch):
    make_plan(scene_of(*centres), "camera.to_world", integrator={"type": "psdr_path", "sppc": 1, "max_depth": 2})
    said = [str(w.message) for w in recwarn if issubclass(w.category, UnsupportedWarning)]
    assert any("ellipsoids of shape 'bodies'" in text for text in said) == touch
