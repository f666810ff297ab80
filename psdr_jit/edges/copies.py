"""Shapes as an instance shows them, as shapes of their own: what edges are made from, not part of the scene.

A copy has the child's own BSDF and textures, its vertices, normals and texture coordinates where the instance puts
them, and the instance's orientation: with M the map of the instance, normals go by det(M)^⅓ M⁻ᵀ, which keeps the
length of unit normals where M scales evenly, and where M mirrors, faces are wound the other way, so that the normal of
a face stays cross(edge, edge). Points of a copy are thereby points of the instance, up to rounding.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import (
    FACES,
    INDEXED_MESHES,
    VERTEX_NORMALS,
    VERTEX_POSITIONS,
    VERTEX_TEXCOORDS,
    mesh_faces,
    mesh_positions,
    pack_positions,
)
from ..errors import UnsupportedError
from ..scene.capabilities import COPIES
from ..scene.graph import named_children
from ..scene.pose_faults import stretches
from ..scene.poses import on_host
from ..scene.shading_normals import interpolates_normals

#: Attributes of meshes, by the first part of their names.
ATTRIBUTES = ("vertex_", "face_")


def copied(child: mi.Shape, plugin: str, instance: mi.Shape, name: str) -> mi.Shape:
    """`child`, a shape of a group, at the place of `instance`. Detached."""
    if INDEXED_MESHES:
        raise UnsupportedError(f"instance '{instance.id()}': edges of instances need Mitsuba 3.9; {COPIES}")
    with dr.suspend_grad():
        to_world = mi.traverse(instance)["to_world"]
        return _mesh(child, to_world, name) if child.is_mesh() else _analytic(child, plugin, to_world, name)


def attributes(mesh: mi.Mesh) -> dict[str, mi.Float]:
    """The buffers of a mesh's attributes, by their names."""
    params, usual = mi.traverse(mesh), (VERTEX_POSITIONS, VERTEX_NORMALS, VERTEX_TEXCOORDS)
    return {key: params[key] for key in params.keys() if key.startswith(ATTRIBUTES) and key not in usual}


def _textures(shape: mi.Shape) -> dict[str, mi.Texture]:
    """Textures that a shape has in place of attributes."""
    return {name: node for name, node in named_children(shape) if isinstance(node, mi.Texture)}


def _volume(matrix: np.ndarray) -> float:
    """By how much the map scales volumes; negative if it mirrors."""
    return float(np.linalg.det(matrix[:3, :3]))


def _mesh(child: mi.Mesh, to_world, name: str) -> mi.Mesh:
    smooth = interpolates_normals(child)
    props = mi.Properties()
    props["bsdf"] = child.bsdf()
    props["flip_normals"] = child.has_flipped_normals()
    props["face_normals"] = child.has_face_normals()
    textured = child.has_vertex_texcoords()
    copy = mi.Mesh(name, child.vertex_count(), child.face_count(), props, smooth, textured)
    for key, buffer in attributes(child).items():
        count = child.vertex_count() if key.startswith("vertex_") else child.face_count()
        values = np.array(dr.detach(buffer)).ravel()
        copy.add_attribute(key, len(values) // count, values)
    for key, texture in _textures(child).items():
        copy.add_texture_attribute(key, texture)
    copy.set_id(name)
    params, volume = mi.traverse(copy), _volume(on_host(to_world))
    params[VERTEX_POSITIONS] = pack_positions(to_world @ dr.detach(mesh_positions(child)))
    faces = mesh_faces(child)
    params[FACES] = dr.ravel(faces if volume > 0 else mi.Vector3u(faces.x, faces.z, faces.y))
    if smooth:
        n = mi.Normal3f(child.vertex_normal(dr.arange(mi.UInt32, child.vertex_count())))
        params[VERTEX_NORMALS] = dr.ravel(to_world @ dr.detach(n) * mi.Float(np.cbrt(abs(volume))))
    if textured:
        params[VERTEX_TEXCOORDS] = dr.detach(child.vertex_texcoords_buffer())
    params.update()
    return copy


def _analytic(child: mi.Shape, plugin: str, to_world, name: str) -> mi.Shape:
    own = on_host(mi.traverse(child)["to_world"])
    matrix = on_host(to_world) @ own
    if stretches(matrix, plugin):
        raise UnsupportedError(
            f"'{name}': the instance stretches or shears a {plugin}, whose outline is not modelled then; scale it "
            "evenly, or use a mesh"
        )
    # A map that mirrors turns a sphere inside out, which an instance does not. A tube only says that it is flipped.
    mirrors = {"sphere": matrix, "cylinder": own}.get(plugin)
    flipped = child.has_flipped_normals() ^ (mirrors is not None and _volume(mirrors) < 0)
    place = {"type": plugin, "id": name, "to_world": mi.ScalarTransform4f(matrix)}
    return mi.load_dict({**place, **_textures(child), "bsdf": child.bsdf(), "flip_normals": flipped})
