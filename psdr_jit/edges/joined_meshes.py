"""Several meshes as one: vertices, faces and edges numbered through, mesh after mesh.

Everything about a shape that is a number is looked up in a table by the shape's own: as a constant of a kernel, it
would make a kernel for every shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, mesh_faces, mesh_positions, positions_buffer
from ..core.joining import joined
from ..core.upload import uploaded
from ..core.varying import varying
from .geometry import EdgeTopologyDevice, upload_topology
from .topology import INVALID, EdgeTopology


@dataclass
class JoinedTopology:
    """Edges of several meshes; of one, its own."""

    device: EdgeTopologyDevice  # vertices and faces numbered through
    shape: mi.UInt32  # by edge: index of its mesh
    first_face: mi.UInt32  # by mesh


def attached_positions(meshes: Sequence[mi.Mesh]) -> mi.Point3f:
    """Vertex positions of all meshes, attached, in the order of the global vertex indices."""
    if len(meshes) == 1:
        # Asked for twice, Dr.Jit 1.5 loses a part of the adjoint of one of two equal gathers; of products it does not.
        return mi.Point3f(mesh_positions(meshes[0]) * varying(mi.Float, 1))
    flat = joined([positions_buffer(mesh) for mesh in meshes])
    return dr.gather(mi.Point3f, flat, dr.arange(mi.UInt32, dr.width(flat) // 3))


def joined_faces(meshes: Sequence[mi.Mesh]) -> mi.Vector3u:
    """Corners of all faces, as numbers of vertices of all meshes."""
    if len(meshes) == 1:
        return mesh_faces(meshes[0])
    vertices, faces = ([count(mesh) for mesh in meshes] for count in (mi.Mesh.vertex_count, mi.Mesh.face_count))
    corners = dr.unravel(mi.Vector3u, joined([faces_buffer(mesh) for mesh in meshes]))
    return corners + uploaded(mi.UInt32, np.repeat(_first(vertices), faces))


def by_face(meshes: Sequence[mi.Mesh]) -> tuple[mi.UInt32, mi.UInt32]:
    """Index of its mesh and number in it, of all faces."""
    faces = [mesh.face_count() for mesh in meshes]
    shape, number = np.repeat(np.arange(len(faces)), faces), np.arange(sum(faces)) - np.repeat(_first(faces), faces)
    return uploaded(mi.UInt32, shape), uploaded(mi.UInt32, number)


def joined_topology(meshes: Sequence[mi.Mesh], topologies: Sequence[EdgeTopology]) -> JoinedTopology:
    """The edges of all meshes; `topologies` of each."""
    faces = _first([mesh.face_count() for mesh in meshes])
    edges = [len(topology) for topology in topologies]
    vertex, face = (
        np.repeat(start, edges).astype(np.uint32) for start in (_first([mesh.vertex_count() for mesh in meshes]), faces)
    )
    together = {name: np.concatenate([getattr(t, name) for t in topologies])
                for name in ("v0", "v1", "w0", "w1", "f0", "f1", "corner0", "corner1", "split")}  # fmt: skip
    for name in ("v0", "v1", "w0", "w1"):
        together[name] = together[name] + vertex
    border = together["f1"] == INVALID
    together["f0"] = together["f0"] + face
    together["f1"] = np.where(border, INVALID, together["f1"] + face)
    counts = dict(nonmanifold_edges=0, degenerate_faces=0, sliver_faces=0, sliver_share=0.0, duplicate_faces=0)
    found = EdgeTopology(**together, **counts)  # what is said of them has been said of each
    shape = uploaded(mi.UInt32, np.repeat(np.arange(len(edges)), edges))
    return JoinedTopology(upload_topology(found), shape, uploaded(mi.UInt32, faces))


def _first(counts: Sequence[int]) -> np.ndarray:
    """Where each of several runs with so many entries begins."""
    return np.cumsum([0, *counts])[:-1]
