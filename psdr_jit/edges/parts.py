"""The connected surfaces that one mesh consists of, and the segments along which they cut into each other. Pure NumPy.

Files often hold an object as several closed bodies in one mesh, pushed into each other. Which face belongs to which
surface follows from the topology; where the surfaces cross is found as it is between meshes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .intersections import Segments, TriangleMesh, mesh_itself, mesh_mesh
from .overlaps import crossing
from .shells import face_components
from .topology import INVALID, EdgeTopology

#: Surfaces in one mesh beyond which (foliage, crumbs) their crossings are not looked for: the time grows with pairs.
MAX_PARTS = 64


@dataclass(frozen=True)
class Part:
    """One connected surface: indices into the faces and edges of its mesh, ascending."""

    faces: np.ndarray
    edges: np.ndarray
    vertices: np.ndarray  # that the faces use


def parts_of(topology: EdgeTopology, faces: np.ndarray) -> tuple[Part, ...]:
    """The connected surfaces of a mesh with `faces` (F, 3); () if there is one, or more than `MAX_PARTS`."""
    label = face_components(topology, len(faces))
    of_edge = label[topology.f0]
    names = np.unique(of_edge)  # faces without an edge are left out of the topology
    if len(names) < 2 or len(names) > MAX_PARTS:
        return ()
    found = []
    for name in names:
        own = np.flatnonzero(label == name)
        found.append(Part(own, np.flatnonzero(of_edge == name), np.unique(faces[own])))
    return tuple(found)


def cut_parts(mesh: TriangleMesh, parts: tuple[Part, ...]) -> Segments:
    """Segments along which `parts` of a mesh cross, their faces numbered as in the mesh. Raises `TooManyPairs`."""
    boxes = [np.stack([x.min(0), x.max(0)]) for x in (mesh.positions[part.vertices] for part in parts)]
    none = np.zeros(0, int)
    found = [Segments(none, none, np.zeros((0, 3)), np.zeros((0, 3)))]
    alone: dict[int, TriangleMesh] = {}
    for i, j in crossing(boxes):
        for k in (i, j):
            alone.setdefault(k, _alone(mesh, parts[k]))
        s = mesh_mesh(alone[i], alone[j])
        found.append(Segments(parts[i].faces[s.face_a], parts[j].faces[s.face_b], s.start, s.end))
    return Segments(*(np.concatenate([getattr(s, name) for s in found]) for name in Segments.__dataclass_fields__))


def crosses_itself(mesh: TriangleMesh, parts: tuple[Part, ...]) -> bool:
    """Does one of the connected surfaces of a mesh cut itself? `parts`: () if there is one. Raises `TooManyPairs`."""
    found, surface = mesh_itself(mesh), np.zeros(len(mesh.faces), int)
    for number, part in enumerate(parts):
        surface[part.faces] = number
    return bool(np.any(surface[found.face_a] == surface[found.face_b]))


def _alone(mesh: TriangleMesh, part: Part) -> TriangleMesh:
    """The part as a mesh of its own."""
    renumbered = np.full(len(mesh.faces) + 1, INVALID, np.int64)
    renumbered[part.faces] = np.arange(len(part.faces))
    edge_faces = mesh.edge_faces[part.edges].astype(np.int64)
    edge_faces = renumbered[np.where(edge_faces == INVALID, len(mesh.faces), edge_faces)]
    vertices, faces, edges = part.vertices, mesh.faces[part.faces], mesh.edges[part.edges]
    return TriangleMesh(
        mesh.positions[vertices], np.searchsorted(vertices, faces), np.searchsorted(vertices, edges), edge_faces
    )
