"""Several meshes as one: vertices, faces and edges numbered through, mesh after mesh.

Everything about a shape that is a number is looked up in a table by the shape's own: as a constant of a kernel, it
would make a kernel for every shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_faces, mesh_positions, positions_buffer
from ..core.joining import joined, joined_points, starts
from ..core.upload import uploaded
from ..core.varying import varying
from ..scene.mesh_tables import joined_corners
from .geometry import EdgeTopologyDevice


@dataclass
class JoinedTopology:
    """Edges of several meshes; of one, its own."""

    device: EdgeTopologyDevice  # vertices and faces numbered through
    shape: mi.UInt32  # by edge: index of its mesh
    prim0: mi.UInt32  # by edge: its faces, by the mesh's own numbers
    prim1: mi.UInt32
    shell: mi.Float  # by edge, see `EdgeRows`


def attached_positions(meshes: Sequence[mi.Mesh]) -> mi.Point3f:
    """Vertex positions of all meshes, attached, in the order of the global vertex indices."""
    if len(meshes) == 1:
        # Asked for twice, Dr.Jit 1.5 loses a part of the adjoint of one of two equal gathers; of products it does not.
        return mi.Point3f(mesh_positions(meshes[0]) * varying(mi.Float, 1))
    return joined_points(mi.Point3f, [positions_buffer(mesh) for mesh in meshes])


def joined_faces(meshes: Sequence[mi.Mesh]) -> mi.Vector3u:
    """Corners of all faces, as numbers of vertices of all meshes."""
    if len(meshes) == 1:
        return mesh_faces(meshes[0])
    return dr.unravel(mi.Vector3u, joined_corners(meshes))


def by_face(meshes: Sequence[mi.Mesh]) -> tuple[mi.UInt32, mi.UInt32]:
    """Index of its mesh and number in it, of all faces."""
    faces = [mesh.face_count() for mesh in meshes]
    shape, number = np.repeat(np.arange(len(faces)), faces), np.arange(sum(faces)) - np.repeat(starts(faces), faces)
    return uploaded(mi.UInt32, shape), uploaded(mi.UInt32, number)


def joined_topology(
    meshes: Sequence[mi.Mesh], devices: Sequence[EdgeTopologyDevice], shells: Sequence[mi.Float]
) -> JoinedTopology:
    """The edges of all meshes; `devices` and `shells` of each."""
    edges = [dr.width(device.v0) for device in devices]
    vertex, face = (uploaded(mi.UInt32, np.repeat(starts([count(mesh) for mesh in meshes]), edges))
                    for count in (mi.Mesh.vertex_count, mi.Mesh.face_count))  # fmt: skip

    def column(name: str):
        parts = [getattr(device, name) for device in devices]
        if dr.depth_v(parts[0]) == 1:
            return joined(parts)
        return type(parts[0])(*(joined([part[axis] for part in parts]) for axis in range(len(parts[0]))))

    own = EdgeTopologyDevice(**{name: column(name) for name in EdgeTopologyDevice.__dataclass_fields__})
    together = replace(own, v0=own.v0 + vertex, v1=own.v1 + vertex, f0=own.f0 + face, f1=own.f1 + face)
    shape = uploaded(mi.UInt32, np.repeat(np.arange(len(edges)), edges))
    found = JoinedTopology(together, shape, own.f0, own.f1, joined(shells))
    dr.eval(found)
    return found
