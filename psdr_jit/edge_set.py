"""All straight edges of a scene that may matter, in one table: topology built once, geometry refreshed per call.

Rows of several meshes are concatenated; vertex indices are global, so that one gather fetches an edge point of any
mesh. The table is detached. Motion is attached separately (`attached_positions`), because an edge table built from
attached mesh buffers breaks forward mode through `ray_intersect`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .compat import mesh_faces, mesh_positions
from .edge_geometry import EdgeTopologyDevice, edge_geometry, upload_topology
from .mesh_edges import WELD_TOLERANCE, build_edge_topology, weld_vertices

#: Exterior angle below which two flat-shaded faces count as one [rad].
COPLANAR_ANGLE = 1e-4

#: Difference of unit shading normals, or of texture coordinates, that makes a split edge a visible seam.
SEAM_TOLERANCE = 1e-4


@dataclass
class EdgeRows:
    """One entry per edge; detached device arrays."""

    v0: mi.UInt32  # global vertex indices of the end points
    v1: mi.UInt32
    p0: mi.Point3f  # their positions [m]
    p1: mi.Point3f
    n0: mi.Normal3f  # unit normals of the adjacent faces, consistently oriented across the edge
    n1: mi.Normal3f
    angle: mi.Float  # exterior angle [rad]
    border: mi.Bool
    seam: mi.Bool  # what the faces reflect may differ along the edge even where both are visible
    shell: mi.Float  # +1: closed surface, normals outward; −1: inward; 0: open, both sides can be seen
    shape0: mi.UInt32  # index into the edge set's meshes, of the first face ...
    shape1: mi.UInt32  # ... and of the second
    prim0: mi.UInt32  # adjacent faces
    prim1: mi.UInt32
    corner0: mi.Vector2u  # corners of the faces at v0 and v1
    corner1: mi.Vector2u


@dataclass
class _MeshTopology:
    """Cached per mesh: valid while the faces stay the same and welded vertices stay together."""

    faces: mi.UInt32  # kept alive, so that its index identifies it
    vertices: int
    device: EdgeTopologyDevice
    closed: bool


@dataclass(frozen=True)
class EdgeSet:
    """Straight edges of `meshes`. `rows` is None when there are none."""

    meshes: tuple[mi.Mesh, ...]
    rows: EdgeRows | None
    shapes: mi.ShapePtr | None  # by EdgeRows.shape0 and shape1


def edge_set(meshes: list[mi.Mesh], moving: list[bool], cache: dict) -> EdgeSet:
    """Edges of `meshes` in their present state; topologies are kept in `cache` from call to call.

    Borders of two shapes that coincide (walls of a room) are one discontinuity and become one row, provided that
    both shapes move or neither does (`moving`): otherwise the row belongs to the shape that moves.
    Raises `SceneError` for empty meshes and non-finite vertices.
    """
    if not meshes:
        return EdgeSet((), None, None)
    parts, first_vertex = [], 0
    for i, mesh in enumerate(meshes):
        positions = dr.detach(mesh_positions(mesh))
        faces = mesh_faces(mesh)
        topology = _cached_topology(mesh, positions, faces, cache)
        parts.append(_rows(mesh, positions, faces, topology, i, first_vertex))
        first_vertex += dr.width(positions)
    rows = parts[0] if len(parts) == 1 else join_borders(_concatenate(parts), moving)
    shapes = mi.ShapePtr(list(meshes)) if len(meshes) > 1 else mi.ShapePtr(meshes[0])
    dr.eval(rows)
    return EdgeSet(tuple(meshes), rows, shapes)


def attached_positions(meshes: tuple[mi.Mesh, ...]) -> mi.Point3f:
    """Vertex positions of all meshes, attached, in the order of the global vertex indices."""
    positions = [mesh_positions(mesh) for mesh in meshes]
    if len(positions) == 1:
        return positions[0]
    return mi.Point3f(*(dr.concat([p[axis] for p in positions]) for axis in range(3)))


def face_uv(corners: mi.Vector2u, t: mi.Float) -> mi.Point2f:
    """Barycentric (b1, b2) of the point at parameter `t` between two corners of a face, as Mitsuba's `prim_uv`."""

    def weight(corner: int) -> mi.Float:
        return dr.select(corners.x == corner, 1 - t, 0) + dr.select(corners.y == corner, t, 0)

    return mi.Point2f(weight(1), weight(2))


def _cached_topology(mesh, positions: mi.Point3f, faces: mi.Vector3u, cache: dict) -> _MeshTopology:
    buffer = dr.ravel(faces)
    dr.eval(buffer)
    key = ("edges", mesh.id(), dr.width(positions), dr.width(faces))
    known = cache.get(key)
    if known is not None and dr.all(known.faces == buffer) and _welds_hold(known.device, positions, faces):
        return known
    p, f = np.array(positions).T, np.array(faces).T
    topology = build_edge_topology(p, f)
    closed = bool(not topology.border.any() and topology.nonmanifold_edges == 0 and len(topology) > 0)
    device = upload_topology(topology)
    closed = closed and bool(dr.all(device.opposed))
    cache[key] = _MeshTopology(buffer, dr.width(positions), device, closed)
    return cache[key]


def _corner_vertex(faces: mi.Vector3u, face: mi.UInt32, corner: mi.UInt32) -> mi.UInt32:
    tri = dr.gather(mi.Vector3u, faces, face)
    return dr.select(corner == 0, tri.x, dr.select(corner == 1, tri.y, tri.z))


def _welds_hold(device: EdgeTopologyDevice, positions: mi.Point3f, faces: mi.Vector3u) -> bool:
    """Do vertices that were welded still coincide? An optimiser may have pulled split vertices apart."""
    other = dr.gather(mi.Point3f, positions, _corner_vertex(faces, device.f1, device.corner1.x))
    own = dr.gather(mi.Point3f, positions, device.v0)
    gap = dr.max(dr.select(device.border, 0, dr.norm(other - own)))
    extent = dr.max(dr.max(positions, axis=1) - dr.min(positions, axis=1), axis=None)
    return bool((gap <= 8 * WELD_TOLERANCE * extent)[0])


def _is_seam(mesh, faces: mi.Vector3u, topo: EdgeTopologyDevice, angle: mi.Float) -> mi.Bool:
    """Edges across which reflected radiance may jump: flat-shaded creases, split normals, texture seams."""
    flat = not mesh.has_vertex_normals() or mesh.has_face_normals()
    seam = angle > COPLANAR_ANGLE if flat else dr.full(mi.Bool, False, dr.width(angle))
    ends = ((topo.v0, topo.corner1.x), (topo.v1, topo.corner1.y))

    def jumps(vertex_data) -> mi.Bool:
        jump = mi.Bool(False)
        for vertex, corner in ends:
            other = dr.gather(type(vertex_data), vertex_data, _corner_vertex(faces, topo.f1, corner))
            jump |= dr.norm(other - dr.gather(type(vertex_data), vertex_data, vertex)) > SEAM_TOLERANCE
        return topo.split & jump

    if not flat:
        seam |= jumps(mesh.vertex_normal(dr.arange(mi.UInt32, mesh.vertex_count())))
    bsdf = mesh.bsdf()
    textured = bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.SpatiallyVarying)
    textured |= mesh.emitter() is not None and mi.has_flag(
        mesh.emitter().flags(), mi.EmitterFlags.SpatiallyVarying
    )
    if textured and mesh.has_vertex_texcoords():
        seam |= jumps(mesh.vertex_texcoord(dr.arange(mi.UInt32, mesh.vertex_count())))
    return seam


def _shell(positions: mi.Point3f, faces: mi.Vector3u, closed: bool) -> float:
    """+1 if the closed surface's normals point outward (positive signed volume), −1 inward, 0 if it is open."""
    if not closed:
        return 0.0
    a, b, c = (dr.gather(mi.Point3f, positions, index) for index in (faces.x, faces.y, faces.z))
    centre = dr.mean(positions, axis=1)
    volume = dr.sum(dr.dot(a - centre, dr.cross(b - centre, c - centre)))
    return 1.0 if float(volume[0]) > 0 else -1.0


def _rows(mesh, positions, faces, topology: _MeshTopology, shape: int, first_vertex: int) -> EdgeRows:
    topo = topology.device
    g = edge_geometry(positions, faces, topo)
    n = dr.width(topo.v0)
    return EdgeRows(
        v0=topo.v0 + first_vertex,
        v1=topo.v1 + first_vertex,
        p0=g.p0,
        p1=g.p1,
        n0=g.n0,
        n1=g.n1,
        angle=g.angle,
        border=topo.border,
        seam=_is_seam(mesh, faces, topo, g.angle),
        shell=dr.full(mi.Float, _shell(positions, faces, topology.closed), n),
        shape0=dr.full(mi.UInt32, shape, n),
        shape1=dr.full(mi.UInt32, shape, n),
        prim0=topo.f0,
        prim1=topo.f1,
        corner0=topo.corner0,
        corner1=topo.corner1,
    )


def _concatenate(parts: list[EdgeRows]) -> EdgeRows:
    def join(values):
        first = values[0]
        if dr.depth_v(first) == 1:
            if dr.is_mask_v(first):  # concatenation moves numbers, not bits
                return dr.concat([dr.select(v, mi.UInt32(1), 0) for v in values]) != 0
            return dr.concat(values)
        return type(first)(*(dr.concat([v[axis] for v in values]) for axis in range(len(first))))

    fields = EdgeRows.__dataclass_fields__
    return EdgeRows(**{name: join([getattr(part, name) for part in parts]) for name in fields})


def join_borders(rows: EdgeRows, moving: list[bool]) -> EdgeRows:
    """Merge coinciding border edges of different shapes into two-faced edges (the second row is dropped)."""
    border = np.flatnonzero(np.array(rows.border))
    if len(border) < 2:
        return rows
    ends = [np.array(dr.gather(mi.Point3f, p, mi.UInt32(border))).T for p in (rows.p0, rows.p1)]
    vertex = weld_vertices(np.concatenate(ends)).reshape(2, -1)
    start, end = vertex
    key = np.minimum(start, end) * (vertex.max() + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    first = first[count == 2]
    a, b = order[first], order[first + 1]
    motion = np.array(moving)[np.array(rows.shape0)[border]]
    same = motion[a] == motion[b]
    a, b = a[same], b[same]
    if len(a) == 0:
        return rows
    keep_a, drop_b, parallel = mi.UInt32(border[a]), mi.UInt32(border[b]), mi.Bool(start[a] == start[b])

    def of_b(values):
        return dr.gather(type(values), values, drop_b)

    # Seen from face a, face b continues the surface if it runs along the edge the other way round.
    n1, corner1 = of_b(rows.n0), of_b(rows.corner0)
    dr.scatter(rows.n1, dr.select(parallel, -n1, n1), keep_a)
    corner1 = dr.select(parallel, corner1, mi.Vector2u(corner1.y, corner1.x))
    dr.scatter(rows.corner1, corner1, keep_a)
    dr.scatter(rows.prim1, of_b(rows.prim0), keep_a)
    dr.scatter(rows.shape1, of_b(rows.shape0), keep_a)
    dr.scatter(rows.border, mi.Bool(False), keep_a)
    dr.scatter(rows.seam, mi.Bool(True), keep_a)
    keep = np.ones(dr.width(rows.border), bool)
    keep[border[b]] = False
    kept = mi.UInt32(np.flatnonzero(keep))
    return dr.gather(EdgeRows, rows, kept)
