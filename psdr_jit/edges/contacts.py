"""Which meshes touch, and where: common parts of their edges, and edges of one in faces of the other.

Looked for between meshes whose boxes touch, and within a mesh between its borders (one side of a seam may be divided
more finely than the other) and the surfaces that it consists of. Found once for every place of a pair of meshes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..core.memory import Memory, Slot, key_of
from . import intersections as cut
from .overlaps import box_of, touching_boxes
from .solids import Solid, state_of, triangles
from .topology import INVALID, WELD_TOLERANCE
from .touching import Resting, Shared, parts_in_faces, shared_parts

#: Exterior angle below which two faces count as one, and their edge is nothing that is seen [rad].
FLAT = 1e-4

#: Edges of a mesh near the other one up to which all are looked at, not its borders alone: a cost per call.
MAX_EDGES = 20000


@dataclass(frozen=True)
class Contact:
    """Two meshes that touch (or one, with itself); edges and faces are numbered as in their topologies."""

    a: Solid
    b: Solid
    shared: Shared  # of edges of a and b
    a_in_b: Resting  # edges of a in faces of b
    b_in_a: Resting


def normals_beside(
    own: cut.TriangleMesh, other: cut.TriangleMesh, resting: Resting
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`(is there a face, its unit normal, that of the face in which the edge rests)`: for one face beside each edge,
    then for the other one.
    """
    there = cut.unit_normals(other.corners(resting.face))
    for face in own.edge_faces[resting.edge].T:
        yield face != INVALID, cut.unit_normals(own.corners(np.where(face == INVALID, 0, face))), there


#: By two meshes: their states, and the contact found for these (None: they do not touch).
CONTACTS: Slot[dict[tuple[str | int, str | int], tuple]] = Slot(dict)


def find_contacts(solids: list[Solid], memory: Memory) -> list[Contact]:
    """All contacts; pairs whose meshes have not been written to are taken from `memory`."""
    found = []
    near = [(solids[i], solids[j]) for i, j in touching_boxes([box_of(solid.mesh) for solid in solids])]
    for a, b in near + [(s, s) for s in solids if s.parts or s.topology.border.any()]:
        key, state = (key_of(a.mesh), key_of(b.mesh)), (state_of(a), state_of(b))
        known = memory[CONTACTS].get(key)
        if known is None or [s.key for s in known[0]] != [s.key for s in state]:
            known = (state, _within(a) if a is b else _between(a, b))
            memory[CONTACTS][key] = known
        if known[1] is not None:
            found.append(known[1])
    return found


def _between(a: Solid, b: Solid) -> Contact | None:
    mesh_a, mesh_b = triangles(a), triangles(b)
    tol = cut.tolerance(mesh_a.box, mesh_b.box, relative=WELD_TOLERANCE)
    common = cut.overlap(mesh_a.box, mesh_b.box, tol)
    if common is None:
        return None
    edges_a, edges_b = (_few(m, _seen(m, cut.in_box(m.positions, m.edges, common))) for m in (mesh_a, mesh_b))
    shared = shared_parts(_ends(mesh_a, edges_a), _ends(mesh_b, edges_b), tol)
    shared = Shared(edges_a[shared.a], edges_b[shared.b], shared.on_a, shared.on_b)
    a_in_b, b_in_a = (
        _in_faces(own, edges, other, common, tol)
        for own, edges, other in ((mesh_a, edges_a, mesh_b), (mesh_b, edges_b, mesh_a))
    )
    if not (len(shared.a) or len(a_in_b.edge) or len(b_in_a.edge)):
        return None
    return Contact(a, b, shared, a_in_b, b_in_a)


def _within(solid: Solid) -> Contact | None:
    """Edges of one mesh that share a part of their length; those that are one and the same are welded elsewhere."""
    mesh, t = triangles(solid), solid.topology
    several = solid.parts and len(t) <= MAX_EDGES
    edges = _seen(mesh, np.arange(len(t))) if several else np.flatnonzero(t.border)
    ends = _ends(mesh, edges)
    tol = cut.tolerance(mesh.box, relative=WELD_TOLERANCE)
    shared = shared_parts(ends, ends, tol)
    once = shared.a < shared.b
    if not once.any():
        return None
    none = Resting(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    return Contact(
        solid, solid, Shared(edges[shared.a[once]], edges[shared.b[once]], shared.on_a[once], shared.on_b[once]),
        none, none,
    )  # fmt: skip


def _few(mesh: cut.TriangleMesh, edges: np.ndarray) -> np.ndarray:
    return edges if len(edges) <= MAX_EDGES else edges[mesh.edge_faces[edges, 1] == INVALID]


def _in_faces(own: cut.TriangleMesh, edges: np.ndarray, other: cut.TriangleMesh, box: np.ndarray, tol: float):
    faces = cut.in_box(other.positions, other.faces, box)
    found = parts_in_faces(_ends(own, edges), other.positions[other.faces[faces]].astype(float), tol)
    return Resting(edges[found.edge], faces[found.face], found.on_edge)


def _ends(mesh: cut.TriangleMesh, edges: np.ndarray) -> np.ndarray:
    return mesh.positions[mesh.edges[edges]].astype(float)


def _seen(mesh: cut.TriangleMesh, edges: np.ndarray) -> np.ndarray:
    """Those of `edges` that are borders, or at which the surface has an angle."""
    normals = [cut.unit_normals(mesh.corners(np.where(side == INVALID, 0, side))) for side in mesh.edge_faces[edges].T]
    bent = np.linalg.norm(np.cross(*normals), axis=1) > FLAT
    folded = np.sum(normals[0] * normals[1], axis=1) < 0
    return edges[bent | folded | (mesh.edge_faces[edges, 1] == INVALID)]
