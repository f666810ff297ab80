"""Which meshes are shaded as something else than their faces.

Exporters write vertex normals for cubes and walls as well, and Mitsuba's own `cube` has them: those are the normals of
the faces, and there is nothing smooth about such a mesh.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from ..core.compat import VERTEX_NORMALS, VERTEX_POSITIONS, faces_buffer, normals_buffer, positions_buffer
from ..core.memory import Memory, Slot, key_of, while_unchanged
from ..core.varying import varying

#: Length of the difference of two unit normals up to which they are the same: files keep few digits.
SAME = 1e-3

#: Faces that are looked at before the others: of what is smooth, some of them are bent.
FIRST = 64

#: Of an integrator: by mesh, its arrays when it was looked at, and whether its normals are those of its faces.
FLAT_MESHES: Slot[dict[str | int, tuple[list, bool]]] = Slot(dict)


def interpolates_normals(mesh: mi.Mesh) -> bool:
    """Is it shaded with vertex normals, whatever these are?"""
    return mesh.has_vertex_normals() and not mesh.has_face_normals()


def is_shaded_smoothly(shape: mi.Shape, memory: Memory, enabled: Iterable[str] = ()) -> bool:
    """Has it normals of its own, or may it get some as the parameters `enabled` change? Remembered while it rests.

    While a function is being frozen, any vertex normals count.
    """
    if not shape.is_mesh() or not interpolates_normals(shape):
        return False
    if {VERTEX_POSITIONS, VERTEX_NORMALS} & set(enabled) or dr.flag(dr.JitFlag.FreezingScope):
        return True
    arrays = [positions_buffer(shape), normals_buffer(shape), faces_buffer(shape)]
    return not while_unchanged(memory[FLAT_MESHES], key_of(shape), arrays, lambda: _has_normals_of_faces(*arrays))


def _has_normals_of_faces(positions: mi.Float, normals: mi.Float, corners: mi.UInt32) -> bool:
    with dr.suspend_grad():
        count = dr.width(corners) // 3
        return all(_agree(positions, normals, corners, first, n) for first, n in
                   ((0, min(FIRST, count)), (FIRST, count - FIRST)) if n > 0)  # fmt: skip


def _agree(positions: mi.Float, normals: mi.Float, corners: mi.UInt32, first: int, count: int) -> bool:
    """Do the normals at the corners of `count` faces belong to these? Faces without area have none."""
    face = dr.arange(mi.UInt32, count) + varying(mi.UInt32, first)
    corner = dr.gather(mi.Vector3u, corners, face)
    p = [dr.gather(mi.Point3f, positions, k) for k in corner]
    n_g = dr.cross(p[1] - p[0], p[2] - p[0])
    doubled = dr.norm(n_g)
    n_g /= dr.select(doubled > 0, doubled, 1)
    off = [dr.norm(dr.gather(mi.Normal3f, normals, k) - n_g) for k in corner]
    return not dr.any((doubled > 0) & ~(dr.maximum(dr.maximum(off[0], off[1]), off[2]) <= SAME))[0]
