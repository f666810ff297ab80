"""Edges of a mesh along which what is looked up at its vertices jumps, and the parts of its surface between them.

A file stores a vertex several times where its faces have normals, texture coordinates or colours of their own there.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_buffers, mesh_faces
from ..core.memory import Memory, Slot, while_unchanged
from .copies import attributes
from .geometry import EdgeTopologyDevice
from .topology import EdgeTopology, connected_components

#: Difference of unit shading normals, or of texture coordinates, that makes a split edge a visible seam.
SEAM_TOLERANCE = 1e-4

#: How often parts of a surface are halved so that each seam has two of them; later, every face is a part.
MOST_HALVINGS = 64

#: Of an integrator: by the name of a mesh, and whether it is painted, its arrays, its seams, and its charts.
CHARTS: Slot[dict[tuple[str, bool], tuple[list, tuple[bytes, np.ndarray | None]]]] = Slot(dict)


def is_smooth(mesh: mi.Mesh) -> bool:
    return mesh.has_vertex_normals() and not mesh.has_face_normals()


def corner_vertex(faces: mi.Vector3u, face: mi.UInt32, corner: mi.UInt32) -> mi.UInt32:
    """The vertex at a corner of a face, by the mesh's own numbers."""
    tri = dr.gather(mi.Vector3u, faces, face)
    return dr.select(corner == 0, tri.x, dr.select(corner == 1, tri.y, tri.z))


def split_seams(mesh: mi.Mesh, painted: bool, topo: EdgeTopologyDevice) -> mi.Bool:
    """(E) edges along which shading normals, or what textures of a `painted` mesh look up at vertices, may jump."""
    found, faces = dr.full(mi.Bool, False, dr.width(topo.v0)), mesh_faces(mesh)
    ends = ((topo.v0, topo.corner1.x), (topo.v1, topo.corner1.y))

    def jumps(vertex_data) -> mi.Bool:
        jump = mi.Bool(False)
        for vertex, corner in ends:
            other = dr.gather(type(vertex_data), vertex_data, corner_vertex(faces, topo.f1, corner))
            jump |= dr.norm(other - dr.gather(type(vertex_data), vertex_data, vertex)) > SEAM_TOLERANCE
        return topo.split & jump

    if is_smooth(mesh):
        found |= jumps(mesh.vertex_normal(dr.arange(mi.UInt32, mesh.vertex_count())))
    if painted and mesh.has_vertex_texcoords():
        found |= jumps(mesh.vertex_texcoord(dr.arange(mi.UInt32, mesh.vertex_count())))
    if painted and any(name.startswith("vertex_") for name in attributes(mesh)):
        found |= topo.split  # whatever the values: they may be optimised, and equal ones make a step of zero
    return found


def charts(
    mesh: mi.Mesh, painted: bool, topology: tuple[EdgeTopology, EdgeTopologyDevice], memory: Memory
) -> np.ndarray | None:
    """`face_charts` of a mesh; None if it has no seams."""
    host, device = topology
    if not host.split.any():
        return None
    kept, key = memory[CHARTS], (mesh.id(), painted)
    last = kept[key][1] if key in kept else None

    def make() -> tuple[bytes, np.ndarray | None]:
        found = np.array(dr.detach(split_seams(mesh, painted, device)))
        mask = np.packbits(found).tobytes()
        if last is not None and last[0] == mask:  # vertices have moved, and normals with them
            return last
        return mask, face_charts(host, found, mesh.face_count()) if found.any() else None

    return while_unchanged(kept, key, list(mesh_buffers(mesh)), make)[1]


def face_charts(topology: EdgeTopology, seam: np.ndarray, faces: int) -> np.ndarray:
    """(F,) parts of a surface such that the two faces of every edge in `seam` (E,) are in different ones.

    What hangs together without crossing a seam is one part, unless both sides of a seam are in it, as where texture
    coordinates start anew on a ball: it is halved by the number of edges that have to be crossed from one of them.
    """
    inner, cut = ~topology.border & ~seam, ~topology.border & seam
    f0, f1 = (f[inner].astype(np.int64) for f in (topology.f0, topology.f1))
    side0, side1 = (f[cut].astype(np.int64) for f in (topology.f0, topology.f1))
    for _ in range(MOST_HALVINGS):
        label = connected_components(faces, f0, f1)
        within = np.flatnonzero(label[side0] == label[side1])
        if len(within) == 0:
            return label
        part, first = np.unique(label[side0[within]], return_index=True)  # one seam of each part
        away = _edges_apart(faces, (f0, f1), side0[within[first]])
        radius = np.full(faces, np.inf)
        radius[part] = (away[side1[within[first]]] + 1) // 2
        beyond = away >= radius[label]
        joined = beyond[f0] == beyond[f1]
        f0, f1 = f0[joined], f1[joined]
    label = connected_components(faces, f0, f1)
    torn = np.isin(label, label[side0[label[side0] == label[side1]]])
    return np.where(torn, faces + np.arange(faces), label)


def _edges_apart(faces: int, links: tuple[np.ndarray, np.ndarray], sources: np.ndarray) -> np.ndarray:
    """(F,) how many of the `links` between two faces have to be crossed from the nearest source; −1: no way."""
    start, end = np.concatenate(links), np.concatenate(links[::-1])
    end = end[np.argsort(start, kind="stable")]
    count = np.bincount(start, minlength=faces)
    first = np.cumsum(count) - count
    away, step, front = np.full(faces, -1), 0, sources
    away[front] = 0
    while len(front):
        step, n = step + 1, count[front]
        place = np.arange(n.sum()) + np.repeat(first[front] - (np.cumsum(n) - n), n)
        front = np.unique(end[place])
        front = front[away[front] < 0]
        away[front] = step
    return away
