"""Faces of smooth-shaded meshes, with the shading normals of their corners: what shading outlines are found on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compat import mesh_faces
from ..core.memory import Memory, Slot
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .segments import attached_positions, is_smooth, known_topology

#: Angle between a shading normal and its face [degrees], and share of the area from which a mesh is bent that far, at
#: which shading and shape no longer belong together.
COARSE, COARSE_SHARE = 35.0, 0.02

#: The same angle under a sky, through which the plane of every face passes.
COARSE_UNDER_SKY = 20.0

#: Of an integrator: the meshes that have been looked at, by name.
LOOKED_AT: Slot[set[str]] = Slot(set)


@dataclass
class FaceRows:
    """One entry per face; detached device arrays."""

    corner: mi.Vector3u  # indices into the vertices of all smooth meshes, one mesh after the other
    shape: mi.UInt32  # index into the smooth meshes
    prim: mi.UInt32  # face of its mesh
    shell: mi.Float  # as of `EdgeRows`
    moves: mi.Bool  # can the face, or its shading normals, move?


@dataclass(frozen=True)
class SmoothFaces:
    """Faces of `meshes`, detached but for what `attached_corners` says."""

    meshes: tuple[mi.Mesh, ...]
    shapes: mi.ShapePtr  # by FaceRows.shape
    rows: FaceRows
    positions: mi.Point3f  # by vertex [m]
    normals: mi.Normal3f  # by vertex, as they are interpolated

    def corners(self, corner: mi.Vector3u, active: mi.Bool) -> tuple[list[mi.Point3f], list[mi.Normal3f]]:
        """Positions [m] and shading normals of the three corners, detached."""
        return _gathered(self.positions, self.normals, corner, active)

    def attached_corners(self, corner: mi.Vector3u, active: mi.Bool) -> tuple[list[mi.Point3f], list[mi.Normal3f]]:
        """The same, attached to the meshes' vertices."""
        return _gathered(attached_positions(self.meshes), _normals(self.meshes), corner, active)


def smooth_faces(meshes: list[mi.Mesh], moving: list[bool], outside: mi.Float, memory: Memory) -> SmoothFaces | None:
    """Faces of those `meshes` that are shaded smoothly; None if there are none. After `segments.edge_set`.

    `outside`, by mesh: 1 if a closed mesh is seen from outside only, else 0.
    """
    parts, chosen, first = [], [], 0
    for i, mesh in enumerate(meshes):
        if not is_smooth(mesh):
            continue
        faces, topology = mesh_faces(mesh), known_topology(mesh, memory)
        n = dr.width(faces)
        parts.append(
            FaceRows(
                corner=faces + first,
                shape=dr.full(mi.UInt32, len(chosen), n),
                prim=dr.arange(mi.UInt32, n),
                shell=topology.facing * dr.gather(mi.Float, outside, i),
                moves=dr.full(mi.Bool, moving[i], n),
            )
        )
        chosen.append(mesh)
        first += mesh.vertex_count()
    if not chosen:
        return None
    rows = parts[0] if len(parts) == 1 else _joined(parts)
    shapes = mi.ShapePtr(chosen) if len(chosen) > 1 else mi.ShapePtr(chosen[0])
    found = SmoothFaces(
        tuple(chosen), shapes, rows, dr.detach(attached_positions(tuple(chosen))), dr.detach(_normals(tuple(chosen)))
    )
    dr.eval(rows, found.positions, found.normals)
    return found


def warn_about_coarse(faces: SmoothFaces, limit: float, memory: Memory) -> None:
    """Name meshes whose shading normals are more than `limit` degrees off their faces, once each.

    Such a face still reflects light along its own plane. Where that plane passes through a light, or through a surface
    that sends light, as much of it as sinks below the plane is lost in a step, which no edge of the mesh stands for.
    """
    unknown = [i for i, mesh in enumerate(faces.meshes) if mesh.id() not in memory[LOOKED_AT]]
    if not unknown or dr.flag(dr.JitFlag.FreezingScope):
        return
    p, n = faces.corners(faces.rows.corner, mi.Bool(True))
    n_g = dr.cross(p[1] - p[0], p[2] - p[0])
    area = dr.norm(n_g)
    least = mi.Float(1)
    for n_s in n:
        least = dr.minimum(least, dr.abs(dr.dot(n_s, n_g)) / (dr.norm(n_s) * area))
    coarse = dr.select(least < math.cos(math.radians(limit)), area, 0)
    for i in unknown:
        memory[LOOKED_AT].add(faces.meshes[i].id())
        own = faces.rows.shape == i
        share = dr.sum(dr.select(own, coarse, 0)) / dr.sum(dr.select(own, area, 0))
        if float(share[0]) > COARSE_SHARE:
            warn_once(
                f"mesh '{faces.meshes[i].id()}' is shaded with normals that are more than {limit:g} degrees off its "
                "faces: where the plane of a face passes through a light or through what is lit, a step of what it "
                "reflects is missing from the derivative; split its normals at sharp edges, set face_normals, or use "
                "a finer mesh",
                UnsupportedWarning,
                memory,
            )


def _joined(parts: list[FaceRows]) -> FaceRows:
    dr.eval(parts)
    moves = dr.concat([dr.select(part.moves, mi.UInt32(1), 0) for part in parts]) != 0
    corner = mi.Vector3u(*(dr.concat([part.corner[axis] for part in parts]) for axis in range(3)))
    shape, prim, shell = (dr.concat([getattr(p, name) for p in parts]) for name in ("shape", "prim", "shell"))
    return FaceRows(corner, shape, prim, shell, moves)


def _normals(meshes: tuple[mi.Mesh, ...]) -> mi.Normal3f:
    """Shading normals of all vertices, attached."""
    parts = [mesh.vertex_normal(dr.arange(mi.UInt32, mesh.vertex_count())) for mesh in meshes]
    if len(parts) == 1:
        return mi.Normal3f(parts[0])
    return mi.Normal3f(*(dr.concat([part[axis] for part in parts]) for axis in range(3)))


def _gathered(positions: mi.Point3f, normals: mi.Normal3f, corner: mi.Vector3u, active: mi.Bool):
    p = [dr.gather(mi.Point3f, positions, corner[k], active) for k in range(3)]
    n = [dr.gather(mi.Normal3f, normals, corner[k], active) for k in range(3)]
    return p, n
