"""Segments along which meshes cut each other move along with these; what changes its shape is looked at anew."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from fuzz.meshes import box
from helpers import mesh_of

from psdr_jit.core.memory import Memory
from psdr_jit.edges import junctions
from psdr_jit.edges.moved_along import affine_map
from psdr_jit.edges.segments import edge_set

pytestmark = pytest.mark.usefixtures("llvm")


def turn() -> np.ndarray:
    return np.array(mi.ScalarTransform4f().rotate([0.2, 1, 0.3], 40).matrix)[:3, :3]


def crossed() -> tuple[np.ndarray, np.ndarray]:
    """A beam through a block, as parts of one mesh."""
    points, faces = box(2)
    block, beam = points * (0.6, 0.5, 0.4), points * (0.25, 0.2, 1.0) @ turn().T
    return np.concatenate([block, beam]), np.concatenate([faces, faces + len(points)])


@pytest.mark.parametrize("linear", [np.eye(3), 2.5 * np.eye(3), np.diag([1.0, 2.0, 0.5])], ids=str)
def test_maps_are_found(linear):
    points = crossed()[0]
    found = affine_map(points, points @ linear @ turn().T + (3, -2, 1))
    x = np.array([[0.1, 0.2, 0.3]])
    assert np.allclose(found(x), x @ linear @ turn().T + (3, -2, 1), atol=1e-6)


def test_there_is_none():
    points = crossed()[0]
    bent = points + 1e-3 * np.sin(5 * points[:, :1])
    assert affine_map(points, bent) is None
    assert affine_map(points, points * (-1, 1, 1)) is None
    assert affine_map(points, points * (0, 1, 1)) is None
    assert affine_map(points, points[:-1]) is None


@pytest.mark.parametrize("change", ["moves", "bends"])
def test_junctions_after_a_change(change, monkeypatch):
    """They are those that are found without knowing of an earlier place, and looked for only where the mesh bends."""
    looked, cut_parts = [], junctions.cut_parts
    monkeypatch.setattr(junctions, "cut_parts", lambda *args: looked.append(0) or cut_parts(*args))
    monkeypatch.setattr(junctions, "FEW_EDGES", 0)
    points, faces = crossed()
    moved = points @ turn().T * 1.5 + (0.3, 0.1, -0.2) if change == "moves" else points + 0.05 * points[:, :1] ** 2
    mesh, memory = mesh_of(points, faces), Memory()

    def found(kept: Memory) -> np.ndarray:
        rows = edge_set([mesh], [True], kept).junctions.edges
        return np.concatenate([np.array(rows.p0), np.array(rows.p1)])

    before = found(memory)
    params = mi.traverse(mesh)
    params["vertex_positions"] = moved.ravel().astype(np.float32)
    params.update()
    after = found(memory)
    assert len(looked) == (1 if change == "moves" else 2)
    assert after.shape == before.shape and np.abs(after - before).max() > 0.01
    assert np.allclose(after, found(Memory()), atol=1e-5)
