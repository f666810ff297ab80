"""All straight edges of a scene that may matter, in one table: topology built once, geometry refreshed per call.

Rows of several meshes are concatenated; vertex indices are global, so that one gather fetches an edge point of any
mesh. The table is detached. Motion is attached separately (`attached_positions`), because an edge table built from
attached mesh buffers breaks forward mode through `ray_intersect`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, mesh_faces, mesh_positions, positions_buffer, same_values
from ..core.joining import joined, pointers
from ..core.memory import Memory, Slot, key_of
from ..core.upload import uploaded
from ..errors import SceneError, UnsupportedWarning
from ..scene.names import shown_name
from ..scene.shading_normals import interpolates_normals
from .coinciding import PointsBetween, divided, join_coinciding
from .contacts import Contact, find_contacts
from .flush_faces import trace_in_flush_faces
from .geometry import EdgeTopologyDevice, edge_geometry, upload_topology
from .joined_meshes import JoinedTopology, attached_positions, joined_faces, joined_topology
from .junctions import JunctionTable, find_junctions
from .parts import Part, parts_of
from .rows import EdgeRows
from .seams import corner_vertex, split_seams
from .shells import edge_shells
from .solids import Ball, Drum, Solid
from .topology import WELD_TOLERANCE, EdgeTopology, build_edge_topology

#: Exterior angle below which two flat-shaded faces count as one [rad].
COPLANAR_ANGLE = 1e-4

#: Share of faces without area among a mesh's edges, by length, up to which what they do is not seen: they take 3 % of
#: the outlines along them at most.
FEW_SLIVERS = 0.1


@dataclass
class MeshTopology:
    """Cached per mesh: valid while faces stay the same, welded vertices together, and outer sides outside."""

    faces: mi.UInt32  # kept alive, so that its index identifies it
    host: EdgeTopology
    device: EdgeTopologyDevice
    shell: mi.Float  # per edge, see EdgeRows
    facing: mi.Float  # per face, the shell of its surface
    kept: mi.Bool  # per face: has it an area, and repeats none before it?
    parts: tuple[Part, ...]  # connected surfaces, if there are several
    place: mi.Float | None = None  # the vertices for which it was last found to hold, kept alive likewise

    @property
    def keeps_all(self) -> bool:
        return self.host.duplicate_faces == self.host.degenerate_faces == 0


#: By mesh and its numbers of vertices and faces.
TOPOLOGIES: Slot[dict[tuple[str | int, int, int], MeshTopology]] = Slot(dict)

#: The topologies of the last edge set, and joined.
TOGETHER: Slot[tuple[list[MeshTopology], JoinedTopology] | None] = Slot(lambda: None)


@dataclass(frozen=True)
class EdgeSet:
    """Straight edges of `meshes`, and the curves along which these cut into each other. `rows`: None without any."""

    meshes: tuple[mi.Mesh, ...]
    rows: EdgeRows | None
    shapes: mi.ShapePtr | None  # by EdgeRows.shape0 and shape1
    junctions: JunctionTable | None  # curves along which the meshes cut into each other, or balls into them
    between: PointsBetween | None = None  # ends of rows that are no vertices; their numbers come after the vertices'
    contacts: tuple[Contact, ...] = ()  # where meshes touch


def edge_set(
    meshes: list[mi.Mesh],
    moving: list[bool],
    memory: Memory,
    balls: tuple[Ball | Drum, ...] = (),
    seams: list[mi.Bool | None] | None = None,
    painted: list[bool] | None = None,
) -> EdgeSet:
    """Edges of `meshes` in their present state; topologies are kept in `memory` from call to call.

    Intersection curves of meshes with each other and with `balls` have rows of their own. Coinciding edges of shapes
    that all move, or all rest (`moving`), become one row, whole edges or parts of them: `coinciding`.
    `seams`: by mesh, the sides of faces along which a pattern steps, 3 · face + opposite corner; None for meshes
    without. `painted`: by mesh, does a texture look something up on it? None: on any may one.
    Raises `SceneError` for empty meshes and non-finite vertices.
    """
    if not meshes:
        return EdgeSet((), None, None, None)
    topologies = [_cached_topology(mesh, memory) for mesh in meshes]
    jumps = []
    for i, (mesh, topology) in enumerate(zip(meshes, topologies, strict=True)):
        jump = split_seams(mesh, painted is None or painted[i], topology.device, topology.host)
        if seams is not None and seams[i] is not None:
            jump |= _on_sides(seams[i], topology.device)
        jumps.append(jump)
    solids = [Solid(mesh, i, moving[i], t.host, t.shell, t.parts)
              for i, (mesh, t) in enumerate(zip(meshes, topologies, strict=True))]  # fmt: skip
    contacts = find_contacts(solids, memory)
    rows = _rows(meshes, topologies, joined(jumps), moving, memory)
    vertices = sum(mesh.vertex_count() for mesh in meshes)
    trace_in_flush_faces(rows, solids, contacts)
    rows, between, shared = divided(rows, solids, contacts, vertices)
    rows = join_coinciding(rows, moving, shared)
    junctions = find_junctions(solids, balls, memory)
    shapes = pointers(mi.ShapePtr, meshes)
    dr.eval(rows)
    return EdgeSet(tuple(meshes), rows, shapes, junctions, between, tuple(contacts))


def known_topology(mesh: mi.Mesh, memory: Memory) -> MeshTopology:
    """What `edge_set` has found out about `mesh` in this call, or what it would."""
    known = memory[TOPOLOGIES].get((key_of(mesh), mesh.vertex_count(), mesh.face_count()))
    return known or _cached_topology(mesh, memory)


def _cached_topology(mesh: mi.Mesh, memory: Memory) -> MeshTopology:
    key = (key_of(mesh), mesh.vertex_count(), mesh.face_count())
    known = memory[TOPOLOGIES].get(key)
    if known is not None and _still_holds(known, mesh):
        return known
    positions, faces = _arrays(mesh)
    p, f = np.array(positions).T, np.array(faces).T
    topology = build_edge_topology(p, f)
    warn_about_mesh(shown_name(mesh), topology)
    shell = edge_shells(topology, p, f)
    facing = np.zeros(len(f), np.float32)
    facing[topology.f0] = shell
    facing[topology.f1[~topology.border]] = shell[~topology.border]
    kept = np.zeros(len(f), bool)
    kept[topology.f0] = kept[topology.f1[~topology.border]] = True
    shells = [uploaded(kind, column) for kind, column in ((mi.Float, shell), (mi.Float, facing), (mi.Bool, kept))]
    known = MeshTopology(faces_buffer(mesh), topology, upload_topology(topology), *shells, parts_of(topology, f))
    memory[TOPOLOGIES][key] = known
    _still_holds(known, mesh)  # true: its kernels are compiled now, not in the next call
    return known


def warn_about_mesh(name: str, topology: EdgeTopology) -> None:
    """Warn about the faces of shape `name` that rays may meet where there is none.

    Faces with two corners in one place, faces that repeat another one, and edges with more than two faces are no loss:
    what is left out of the topology is in the place of what is kept, and borders in one place become one edge with
    traced sides (`coinciding`). A mesh without any edge is refused: nothing of it can be seen.
    """
    if len(topology) == 0:
        raise SceneError(f"mesh '{name}' has no face with an area; remove it or fix its file")
    if topology.sliver_share > FEW_SLIVERS:
        message = (f"mesh '{name}' has {topology.sliver_faces} faces without area, their corners in a row: rays along "
                   "one of them meet it at any distance, which takes some 3 % of the derivative of outlines there; "
                   "remove these faces")  # fmt: skip
        warnings.warn(message, UnsupportedWarning, stacklevel=2)


def _arrays(mesh: mi.Mesh) -> tuple[mi.Point3f, mi.Vector3u]:
    """Vertices and faces, evaluated: kernels depend on whether they still have to be computed."""
    positions, faces = dr.detach(mesh_positions(mesh)), mesh_faces(mesh)
    dr.eval(positions, faces)
    return positions, faces


def _still_holds(known: MeshTopology, mesh: mi.Mesh) -> bool:
    if not same_values(known.faces, faces_buffer(mesh)):
        return False
    place, last = dr.detach(positions_buffer(mesh)), known.place
    if last is None or last.index != place.index:  # whatever writes to a mesh gives it another buffer
        arrays = _arrays(mesh)
        holds = _welds_hold(known.device, *arrays) & _still_outward(known.facing, *arrays)
        known.place = place if bool(holds[0]) else None
    return known.place is not None


def _still_outward(facing: mi.Float, positions: mi.Point3f, faces: mi.Vector3u) -> mi.Bool:
    """Are the closed surfaces, taken together, still turned as `facing` says? A mesh mirrored in place is not."""
    a, b, c = (dr.gather(mi.Point3f, positions, corner) - dr.gather(mi.Point3f, positions, 0) for corner in faces)
    return dr.sum(facing * dr.dot(a, dr.cross(b, c))) >= 0


def _welds_hold(device: EdgeTopologyDevice, positions: mi.Point3f, faces: mi.Vector3u) -> mi.Bool:
    """Do vertices that were welded still coincide? An optimiser may have pulled split vertices apart."""
    other = dr.gather(mi.Point3f, positions, corner_vertex(faces, device.f1, device.corner1.x))
    own = dr.gather(mi.Point3f, positions, device.v0)
    gap = dr.max(dr.select(device.border, 0, dr.norm(other - own)))
    extent = dr.max(dr.max(positions, axis=1) - dr.min(positions, axis=1), axis=None)
    return gap <= 8 * WELD_TOLERANCE * extent


def _on_sides(sides: mi.Bool, topo: EdgeTopologyDevice) -> mi.Bool:
    """Edges that are among the `sides` of one of their faces (3 · face + opposite corner)."""
    side0, side1 = 3 * topo.f0 + topo.apex0, 3 * topo.f1 + topo.apex1
    return dr.gather(mi.Bool, sides, side0) | dr.gather(mi.Bool, sides, side1)


def _rows(
    meshes: list[mi.Mesh], topologies: list[MeshTopology], jumps: mi.Bool, moving: list[bool], memory: Memory
) -> EdgeRows:
    """One row per edge of each mesh, in order."""
    together = _together(meshes, topologies, memory)
    positions, faces, topo = dr.detach(attached_positions(meshes)), joined_faces(meshes), together.device
    dr.eval(positions, faces, jumps)
    g = edge_geometry(positions, faces, topo)
    shape, shell = together.shape, together.shell
    smooth, moves = (dr.gather(mi.Bool, uploaded(mi.Bool, np.array(flags)), shape)
                     for flags in ([interpolates_normals(mesh) for mesh in meshes], moving))  # fmt: skip
    return EdgeRows(
        v0=mi.UInt32(topo.v0),
        v1=mi.UInt32(topo.v1),
        p0=g.p0,
        p1=g.p1,
        n0=g.n0,
        n1=g.n1,
        angle=g.angle,
        blur=g.blur,
        inset0=g.inset0,
        inset1=g.inset1,
        border=mi.Bool(topo.border),  # copies: joining coinciding edges writes into rows
        seam=jumps | (g.angle > COPLANAR_ANGLE),
        smooth=~jumps & smooth,
        pattern=jumps,
        traced=dr.full(mi.Bool, False, dr.width(topo.v0)),
        moves=moves,
        shell0=mi.Float(shell),
        shell1=mi.Float(shell),
        shape0=mi.UInt32(shape),
        shape1=mi.UInt32(shape),
        prim0=mi.UInt32(together.prim0),
        prim1=mi.UInt32(together.prim1),
        corner0=mi.Vector2u(topo.corner0),
        corner1=mi.Vector2u(topo.corner1),
    )


def _together(meshes: list[mi.Mesh], topologies: list[MeshTopology], memory: Memory) -> JoinedTopology:
    """The topologies as one, kept while each of them is."""
    known = memory[TOGETHER]
    if known is None or [id(topology) for topology in known[0]] != [id(topology) for topology in topologies]:
        found = joined_topology(meshes, *zip(*((t.device, t.shell) for t in topologies), strict=True))
        known = memory[TOGETHER] = (topologies, found)
    return known[1]
