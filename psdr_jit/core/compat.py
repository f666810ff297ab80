"""Every Mitsuba name that differs between versions, and nothing else.

Mitsuba 3.10 renames the mesh parameters and stores them as (N, 3) tensors. It is unreleased: the names here
follow its announcement, and only 3.9 has been run.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError

INDEXED_MESHES = tuple(int(part) for part in mi.__version__.split(".")[:2]) >= (3, 10)
"""Meshes of this Mitsuba are tensors that may be indexed separately from the vertices."""

VERTEX_POSITIONS = "positions" if INDEXED_MESHES else "vertex_positions"
VERTEX_NORMALS = "normals" if INDEXED_MESHES else "vertex_normals"
VERTEX_TEXCOORDS = "texcoords" if INDEXED_MESHES else "vertex_texcoords"
FACES = "faces"
CONTROL_POINTS = "control_points"  # of curves: x, y, z and radius of each, flat


def mesh_positions(mesh: mi.Mesh) -> mi.Point3f:
    """Vertex positions (V), world space, attached if the mesh is."""
    if not INDEXED_MESHES:
        # not the traversed parameter: a `rectangle` has this buffer but exposes its pose only
        # and not `dr.unravel`, whose adjoint in Dr.Jit 1.5 overwrites the buffer's gradient instead of adding to it
        return dr.gather(mi.Point3f, mesh.vertex_positions_buffer(), dr.arange(mi.UInt32, mesh.vertex_count()))
    return mi.Point3f(_parameter(mesh, VERTEX_POSITIONS), flip_axes=True)


def positions_buffer(mesh: mi.Mesh) -> mi.Float:
    """The array that holds the vertex positions, replaced whenever they change; attached if the mesh is."""
    return _parameter(mesh, VERTEX_POSITIONS).array if INDEXED_MESHES else mesh.vertex_positions_buffer()


def vertex_buffers(mesh: mi.Mesh) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Positions, normals and texture coordinates; empty where it has none."""
    return positions_buffer(mesh), normals_buffer(mesh), texcoords_buffer(mesh)


def mesh_buffers(mesh: mi.Mesh) -> tuple:
    """All arrays on which edges depend; each is replaced by another when it changes."""
    return (*vertex_buffers(mesh), faces_buffer(mesh))


def normals_buffer(mesh: mi.Mesh) -> mi.Float:
    """The array that holds the vertex normals, replaced whenever they change; may be empty."""
    if not INDEXED_MESHES:
        return mesh.vertex_normals_buffer()
    return _parameter(mesh, VERTEX_NORMALS).array if mesh.has_vertex_normals() else mi.Float()


def texcoords_buffer(mesh: mi.Mesh) -> mi.Float:
    """The array that holds the texture coordinates of the vertices, replaced whenever they change; may be empty."""
    if not INDEXED_MESHES:
        return mesh.vertex_texcoords_buffer()
    return _parameter(mesh, VERTEX_TEXCOORDS).array if mesh.has_vertex_texcoords() else mi.Float()


def mesh_faces(mesh: mi.Mesh) -> mi.Vector3u:
    """Corner indices (F) into `mesh_positions`."""
    if not INDEXED_MESHES:
        return dr.unravel(mi.Vector3u, mesh.faces_buffer())
    return mi.Vector3u(_parameter(mesh, FACES), flip_axes=True)


def faces_buffer(mesh: mi.Mesh) -> mi.UInt32:
    """The array that holds the corner indices, replaced whenever they change."""
    return _parameter(mesh, FACES).array if INDEXED_MESHES else mesh.faces_buffer()


def same_values(a: mi.UInt32 | mi.Float, b: mi.UInt32 | mi.Float) -> bool:
    """Do two flat arrays agree? At once if they are one array; else on the host, so that no kernel is met late."""
    return a.index == b.index or (dr.width(a) == dr.width(b) and np.array_equal(np.array(a), np.array(b)))


def pack_positions(points: mi.Point3f) -> mi.Float | mi.TensorXf:
    """`points` in the form in which the parameter `VERTEX_POSITIONS` is assigned."""
    return mi.TensorXf(points, flip_axes=True) if INDEXED_MESHES else dr.ravel(points)


def _parameter(mesh: mi.Mesh, key: str):
    params = mi.traverse(mesh)
    if "position_index" in params and dr.width(params["position_index"]) > 0:
        raise UnsupportedError(
            f"mesh '{mesh.id()}' indexes its positions separately from its vertices; "
            "export it with one position per vertex"
        )
    return params[key]
