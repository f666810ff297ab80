"""Edges of a mesh along which what is looked up at its vertices jumps, and the parts of its surface between them.

A file stores a vertex several times where its faces have normals, texture coordinates or colours of their own there.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_buffers, mesh_faces
from ..core.memory import Memory, Slot, key_of, while_unchanged
from ..scene.shading_normals import interpolates_normals
from .copies import attributes
from .geometry import EdgeTopologyDevice
from .topology import EdgeTopology, connected_components

#: Difference of unit shading normals, or of texture coordinates, that makes a split edge a visible seam.
SEAM_TOLERANCE = 1e-4

#: How many edges away the bank of a seam reaches, for each of its faces along the seam.
REACH = 2

#: Of an integrator: by mesh, and whether it is painted, its arrays, the seams (E,) it has had, and its
#: charts.
CHARTS: Slot[dict[tuple[str | int, bool], tuple[list, tuple[np.ndarray, np.ndarray | None]]]] = Slot(dict)


def corner_vertex(faces: mi.Vector3u, face: mi.UInt32, corner: mi.UInt32) -> mi.UInt32:
    """The vertex at a corner of a face, by the mesh's own numbers."""
    tri = dr.gather(mi.Vector3u, faces, face)
    return dr.select(corner == 0, tri.x, dr.select(corner == 1, tri.y, tri.z))


def split_seams(mesh: mi.Mesh, painted: bool, topo: EdgeTopologyDevice, host: EdgeTopology) -> mi.Bool:
    """(E) edges along which shading normals, or what textures of a `painted` mesh look up at vertices, may jump."""
    found = dr.full(mi.Bool, False, dr.width(topo.v0))
    if not host.split.any():
        return found
    faces = mesh_faces(mesh)
    ends = ((topo.v0, topo.corner1.x), (topo.v1, topo.corner1.y))

    def jumps(vertex_data) -> mi.Bool:
        jump = mi.Bool(False)
        for vertex, corner in ends:
            other = dr.gather(type(vertex_data), vertex_data, corner_vertex(faces, topo.f1, corner))
            jump |= dr.norm(other - dr.gather(type(vertex_data), vertex_data, vertex)) > SEAM_TOLERANCE
        return topo.split & jump

    if interpolates_normals(mesh):
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
    kept, key = memory[CHARTS], (key_of(mesh), painted)
    last = kept[key][1] if key in kept else (np.zeros(len(host), bool), None)

    def make() -> tuple[np.ndarray, np.ndarray | None]:
        # what has been a seam stays one: normals that are computed anew come and go by rounding
        seam = last[0] | np.array(dr.detach(split_seams(mesh, painted, device, host)))
        return last if (seam == last[0]).all() else (seam, face_charts(host, seam, mesh.face_count()))

    return while_unchanged(kept, key, list(mesh_buffers(mesh)), make)[1]


def face_charts(topology: EdgeTopology, seam: np.ndarray, faces: int) -> np.ndarray:
    """(F,) parts of a surface such that the two faces of every edge in `seam` (E,) are in different ones.

    What hangs together without crossing a seam is one part, unless both sides of a seam are in it, as where texture
    coordinates start anew on a ball: faces then belong to the bank of the seam that is the fewest edges away, if it is
    as near as the bank is long.
    """
    inner, cut = ~topology.border & ~seam, ~topology.border & seam
    f0, f1 = (f[inner].astype(np.int64) for f in (topology.f0, topology.f1))
    side0, side1 = (f[cut].astype(np.int64) for f in (topology.f0, topology.f1))
    label = connected_components(faces, f0, f1)
    within = label[side0] == label[side1]
    if not within.any():
        return label
    side0, side1 = side0[within], side1[within]
    bank = _banks(topology, (inner, cut), faces)
    bank[side0] = np.where(bank[side0] == bank[side1], faces + side0, bank[side0])  # a slit that ends on both sides
    torn = np.isin(label, label[side0])
    nearest = _nearest(faces, (f0, f1), np.concatenate([side0, side1]), bank)
    return np.where(torn & (nearest >= 0), faces + nearest, label)


def _banks(topology: EdgeTopology, kinds: tuple[np.ndarray, np.ndarray], faces: int) -> np.ndarray:
    """(F,) which faces along seams are on the same bank: joined around vertices at which a seam goes on.

    `kinds`: the edges (E,) within the surface that are no seams, and those that are.
    """
    inner, cut = kinds
    count = np.bincount(np.concatenate([topology.w0[cut], topology.w1[cut]]), minlength=int(topology.w1.max()) + 1)
    goes_on = inner & ((count[topology.w0] > 1) | (count[topology.w1] > 1))
    return connected_components(faces, *(f[goes_on].astype(np.int64) for f in (topology.f0, topology.f1)))


def _nearest(faces: int, links: tuple[np.ndarray, np.ndarray], sources: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(F,) label of the source that is the fewest `links` between two faces away; −1: none is within `REACH`."""
    start, end = np.concatenate(links), np.concatenate(links[::-1])
    end = end[np.argsort(start, kind="stable")]
    count = np.bincount(start, minlength=faces)
    first = np.cumsum(count) - count
    found, front = np.full(faces, -1), np.unique(sources)
    found[front] = label[front]
    reach, step = REACH * np.bincount(label[front], minlength=int(label.max()) + 1), 0
    while len(front):
        step += 1
        front = front[reach[found[front]] >= step]
        n = count[front]
        place = np.arange(n.sum()) + np.repeat(first[front] - (np.cumsum(n) - n), n)
        reached, value = end[place], np.repeat(found[front], n)
        new = found[reached] < 0
        found[reached[new]] = value[new]
        front = np.unique(reached[new])
    return found
