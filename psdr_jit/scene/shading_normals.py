"""Which meshes are shaded as something else than their faces.

Exporters write vertex normals for cubes and walls as well, and Mitsuba's own `cube` has them: those are the normals of
the faces, and there is nothing smooth about such a mesh.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import VERTEX_NORMALS, VERTEX_POSITIONS, faces_buffer, normals_buffer, positions_buffer
from ..core.memory import Memory, Slot, key_of, while_unchanged

#: Length of the difference of two unit normals up to which they are the same: files keep few digits.
SAME = 1e-3

#: Faces that are looked at before the others: of what is smooth, some of them are bent.
FIRST = 64

#: Of an integrator: by mesh, its arrays when it was looked at, and whether its normals are those of its faces.
FLAT_MESHES: Slot[dict[str | int, tuple[list, bool]]] = Slot(dict)


def is_shaded_smoothly(shape: mi.Shape, memory: Memory, enabled: Iterable[str] = ()) -> bool:
    """Has it normals of its own, or may it get some as the parameters `enabled` change? Remembered while it rests.

    While a function is being frozen, any vertex normals count.
    """
    if not shape.is_mesh() or not shape.has_vertex_normals() or shape.has_face_normals():
        return False
    if {VERTEX_POSITIONS, VERTEX_NORMALS} & set(enabled) or dr.flag(dr.JitFlag.FreezingScope):
        return True
    arrays = [positions_buffer(shape), normals_buffer(shape), faces_buffer(shape)]
    return not while_unchanged(memory[FLAT_MESHES], key_of(shape), arrays, lambda: _has_normals_of_faces(*arrays))


def _has_normals_of_faces(positions: mi.Float, normals: mi.Float, corners: mi.UInt32) -> bool:
    p, n = (np.array(dr.detach(array), np.float64).reshape(-1, 3) for array in (positions, normals))
    faces = np.array(corners).reshape(-1, 3)
    return all(_agree(p[part], n[part]) for part in (faces[:FIRST], faces[FIRST:]))


def _agree(p: np.ndarray, n: np.ndarray) -> bool:
    """Do the normals `n` of corners at `p`, both (F, 3, 3), belong to their faces? Those without area have none."""
    with np.errstate(invalid="ignore"):  # vertices that are no numbers are complained of elsewhere
        n_g = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    doubled = np.linalg.norm(n_g, axis=-1)
    there = doubled > 0
    off = n[there] - (n_g[there] / doubled[there, None])[:, None]
    return bool((np.linalg.norm(off, axis=-1) <= SAME).all())
