"""Meshes whose vertex normals are those of their faces are not shaded smoothly, unless these may change."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.memory import Memory
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.shading_normals import SAME, is_shaded_smoothly


def box() -> dict:
    return {"type": "cube", "to_world": mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 33).scale([1, 2, 0.5])}


def bent(by: float, face: int = 0) -> mi.Mesh:
    """A cube with the normal of one corner turned by an angle [rad]."""
    cube = mi.load_dict(box())
    params = mi.traverse(cube)
    normals = np.array(params["vertex_normals"]).reshape(-1, 3)
    corner = np.array(params["faces"]).reshape(-1, 3)[face, 1]
    across = np.cross(normals[corner], [0.36, 0.48, 0.8])
    normals[corner] = np.cos(by) * normals[corner] + np.sin(by) * across / np.linalg.norm(across)
    params["vertex_normals"] = mi.Float(normals.ravel())
    params.update()
    return cube


def test_normals_of_the_faces(llvm):
    assert not is_shaded_smoothly(mi.load_dict(box()), Memory())
    assert not is_shaded_smoothly(mi.load_dict({"type": "sphere"}), Memory())
    assert not is_shaded_smoothly(bent(SAME / 2), Memory())


@pytest.mark.parametrize("face", [0, 11])
@pytest.mark.parametrize("by", [2 * SAME, 0.1, np.pi])
def test_other_normals(llvm, by, face):
    """Those that point inwards as well."""
    assert is_shaded_smoothly(bent(by, face), Memory())


def test_many_faces_are_looked_at_to_the_last(llvm):
    n = 200
    grid = np.stack([*np.meshgrid(np.arange(n + 1.0), [0.0, 1.0])], -1).reshape(-1, 2)
    mesh = mi.Mesh("strip", len(grid), 2 * n, has_vertex_normals=True)
    params = mi.traverse(mesh)
    a = np.arange(n)
    faces = np.concatenate([np.stack([a, a + 1, a + n + 1], -1), np.stack([a + 1, a + n + 2, a + n + 1], -1)])
    normals = np.tile([0.0, 0.0, 1.0], (len(grid), 1))
    params["vertex_positions"] = mi.Float(np.pad(grid, ((0, 0), (0, 1))).ravel())
    params["faces"] = mi.UInt32(faces.ravel())
    params["vertex_normals"] = mi.Float(normals.ravel())
    params.update()
    memory = Memory()
    assert not is_shaded_smoothly(mesh, memory)
    normals[-1] = [0.6, 0, 0.8]
    params["vertex_normals"] = mi.Float(normals.ravel())
    params.update()
    assert is_shaded_smoothly(mesh, memory), "new normals were not looked at"


@pytest.mark.parametrize("name, smooth", [
    ("body.vertex_positions", True), ("body.vertex_normals", True), ("body.bsdf.reflectance.value", False),
])  # fmt: skip
def test_normals_that_may_change(llvm, name, smooth):
    """A vertex turns the faces about it, and what is computed from them."""
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, "body": box()}, optimize=False)
    params = mi.traverse(scene)
    offset = mi.Float(0)
    dr.enable_grad(offset)
    params[name] += offset
    params.update()
    assert analyse(scene).shapes[0].smooth == smooth
