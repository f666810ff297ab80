"""Faces of smooth-shaded meshes, with the shading normals of their corners: what shading outlines are found on."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import normals_buffer
from ..core.joining import joined, joined_points, pointers
from ..core.memory import Memory
from ..core.upload import uploaded
from ..core.varying import varying
from ..scene.shading_normals import interpolates_normals
from .joined_meshes import attached_positions, by_face, joined_faces
from .segments import known_topology


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
    again: bool = False  # do others ask for the attached normals of the same meshes?

    def corners(self, corner: mi.Vector3u, active: mi.Bool) -> tuple[list[mi.Point3f], list[mi.Normal3f]]:
        """Positions [m] and shading normals of the three corners, detached."""
        return _gathered(self.positions, self.normals, corner, active)

    def attached_corners(self, corner: mi.Vector3u, active: mi.Bool) -> tuple[list[mi.Point3f], list[mi.Normal3f]]:
        """The same, attached to the meshes' vertices."""
        normals = _normals(self.meshes)
        if self.again:  # a product, for the reason given in `attached_positions`
            normals = mi.Normal3f(normals * varying(mi.Float, 1))
        return _gathered(attached_positions(self.meshes), normals, corner, active)


def smooth_faces(meshes: list[mi.Mesh], moving: list[bool], outside: mi.Float, memory: Memory) -> SmoothFaces | None:
    """Faces of those `meshes` that are shaded smoothly; None if there are none. After `segments.edge_set`.

    `outside`, by mesh: 1 if a closed mesh is seen from outside only, else 0.
    """
    places = [i for i, mesh in enumerate(meshes) if interpolates_normals(mesh)]
    chosen = [meshes[i] for i in places]
    if not chosen:
        return None
    shape, prim = by_face(chosen)
    topologies = [known_topology(mesh, memory) for mesh in chosen]
    place = dr.gather(mi.UInt32, uploaded(mi.UInt32, np.array(places)), shape)
    rows = FaceRows(
        corner=joined_faces(chosen),
        shape=shape,
        prim=prim,
        shell=joined([topology.facing for topology in topologies]) * dr.gather(mi.Float, outside, place),
        moves=dr.gather(mi.Bool, uploaded(mi.Bool, np.array(moving)), place),
    )
    if not all(topology.keeps_all for topology in topologies):  # what rays may meet at one place is there once
        rows = dr.gather(FaceRows, rows, dr.compress(joined([topology.kept for topology in topologies])))
    shapes = pointers(mi.ShapePtr, chosen)
    found = SmoothFaces(
        tuple(chosen), shapes, rows, dr.detach(attached_positions(tuple(chosen))), dr.detach(_normals(tuple(chosen)))
    )
    dr.eval(rows, found.positions, found.normals)
    return found


def _normals(meshes: tuple[mi.Mesh, ...]) -> mi.Normal3f:
    """Shading normals of all vertices, attached."""
    return joined_points(mi.Normal3f, [normals_buffer(mesh) for mesh in meshes])


def _gathered(positions: mi.Point3f, normals: mi.Normal3f, corner: mi.Vector3u, active: mi.Bool):
    p = [dr.gather(mi.Point3f, positions, corner[k], active) for k in range(3)]
    n = [dr.gather(mi.Normal3f, normals, corner[k], active) for k in range(3)]
    return p, n
