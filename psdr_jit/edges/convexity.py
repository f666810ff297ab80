"""Which bodies are convex? If there is only one, and it is, nothing casts a shadow and no surface sees another."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, mesh_faces, mesh_positions, positions_buffer, same_values
from ..core.memory import Memory, Slot, key_of, while_unchanged
from ..core.sensor_frame import origin_box, sensor_frame
from ..core.varying import varying
from ..scene.capabilities import SUPPORTED_SENSORS
from ..scene.facts import SceneFacts, ShapeFacts
from .coarse import bent_meshes
from .overlaps import apart
from .shells import edge_shells
from .topology import build_edge_topology

#: By name of a mesh: its faces, and whether they are one closed surface with its normals outward.
CLOSED: Slot[dict[str | int, tuple[mi.UInt32, bool]]] = Slot(dict)
#: Likewise: whether a closed one is convex, for as long as its arrays are the same.
CONVEX: Slot[dict] = Slot(dict)

#: Pairs of a face and a vertex up to which a mesh is looked at.
MAX_PAIRS = 2**22

#: Height of a vertex above the plane of a face, relative to the extent of the mesh, that counts as rounding.
FLATNESS = 1e-5


def lone_convex(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts, memory: Memory) -> str:
    """Name of the scene's only shape if it is convex, opaque, and the sensor outside of its bounding box; else "".

    If it is shaded as something else, it hides from itself what shines on it: then it does not count as alone.
    """
    if len(facts.shapes) != 1 or facts.sensor.plugin not in SUPPORTED_SENSORS:
        return ""
    only = facts.shapes[0]
    if only.index < 0 or not only.opaque:
        return ""
    box, (lower, upper) = scene.bbox(), origin_box(sensor_frame(sensor))
    if not apart(lower, upper, box):
        return ""
    if only.smooth and all(bent_meshes([scene.shapes()[0]], memory)):
        return ""
    flat = only.plugin in ("disk", "rectangle")
    return only.name if flat or is_convex_body(scene.shapes()[0], only, memory) else ""


def is_convex_body(shape: mi.Shape, facts: ShapeFacts, memory: Memory) -> bool:
    """Is it a sphere, or a closed convex mesh with its normals outward? False of meshes too large to look at."""
    if facts.plugin == "sphere":
        return True
    if not facts.is_mesh or facts.faces * shape.vertex_count() > MAX_PAIRS:
        return False
    if not _is_closed(shape, memory):
        return False
    arrays = [positions_buffer(shape), faces_buffer(shape)]
    return while_unchanged(memory[CONVEX], key_of(shape), arrays, lambda: _is_behind_its_faces(shape))


def _is_closed(mesh: mi.Mesh, memory: Memory) -> bool:
    """One closed surface with its normals outward. Remembered while the faces are the same."""
    faces = faces_buffer(mesh)
    known = memory[CLOSED].get(key_of(mesh))
    if known is None or not same_values(known[0], faces):
        p, f = np.array(dr.detach(mesh_positions(mesh))).T, np.array(mesh_faces(mesh)).T
        topology = build_edge_topology(p, f)
        known = (faces, len(topology) > 0 and bool((edge_shells(topology, p, f) > 0).all()))
        memory[CLOSED][key_of(mesh)] = known
    return known[1]


def _is_behind_its_faces(mesh: mi.Mesh) -> bool:
    """Is every vertex on or behind the plane of every face?"""
    positions, faces = dr.detach(mesh_positions(mesh)), mesh_faces(mesh)
    n = dr.width(positions)
    pair = dr.arange(mi.UInt32, dr.width(faces) * n)
    corners = dr.gather(mi.Vector3u, faces, pair // n)
    a, b, c = (dr.gather(mi.Point3f, positions, corners[k]) for k in range(3))
    normal = dr.normalize(dr.cross(b - a, c - a))
    height = dr.dot(normal, dr.gather(mi.Point3f, positions, pair % n) - a)
    extent = varying(mi.Float, float(dr.norm(mesh.bbox().extents())))
    return not dr.any(height > FLATNESS * extent)[0]
