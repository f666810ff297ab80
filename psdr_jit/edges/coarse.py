"""Which smooth-shaded meshes have normals far off their faces: too far for shading and shape to belong together."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..core.compat import mesh_buffers, mesh_faces, mesh_positions
from ..core.memory import Memory, Slot, key_of, while_unchanged
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..scene.names import shown_name

#: Angle between a shading normal and its face [degrees] from which the horizons of the faces (`horizons.py`) are worth
#: samples, and share of the area from which a mesh is bent that far.
BENT, BENT_SHARE = 5.0, 0.02

#: The same angle for materials that prefer some directions: seen from along the surface, they reflect most along it.
#: Of rough metal (alpha .3) under a sky, a vertex on the outline of a ball of 64 segments, whose normals are 2.8
#: degrees off, 3 % of the derivative are horizons. Of diffuse balls as fine as that, less than .4 %.
BENT_GLOSSY = 1.5

#: Angle [degrees] from which, over the same share, what no horizon stands for is worth a warning; and under a sky,
#: through which the plane of every face passes.
COARSE, COARSE_UNDER_SKY = 35.0, 20.0

#: Of an integrator: by name of a mesh and limit, its arrays when it was looked at, and whether it is bent that far.
BENT_MESHES: Slot[dict[tuple[str | int, float], tuple[list, bool]]] = Slot(dict)

#: Of an integrator: the meshes that have been looked at for a warning, by name, and with which limit.
LOOKED_AT: Slot[set[tuple[str | int, float]]] = Slot(set)


def bent_meshes(meshes: list[mi.Mesh], memory: Memory) -> list[bool]:
    """By mesh: are its normals so far off its faces that their horizons matter? Remembered while it rests."""
    return [bends(mesh, BENT_GLOSSY if _is_glossy(mesh) else BENT, memory) for mesh in meshes]


def _is_glossy(mesh: mi.Mesh) -> bool:
    return mi.has_flag(mesh.bsdf().flags(), mi.BSDFFlags.Glossy)


def bends(mesh: mi.Mesh, limit: float, memory: Memory) -> bool:
    """Are normals more than `limit` degrees off their faces, over `BENT_SHARE`? Remembered while the mesh rests."""
    with dr.suspend_grad():
        kept, buffers = memory[BENT_MESHES], list(mesh_buffers(mesh))
        return while_unchanged(kept, (key_of(mesh), limit), buffers, lambda: _bent_share(mesh, limit) > BENT_SHARE)


def warn_about_coarse(meshes: list[mi.Mesh], limit: float, memory: Memory) -> None:
    """Name meshes whose shading normals are more than `limit` degrees off their faces, once each.

    For meshes that let light through: of what they send, as much as sinks below the plane of one of their
    faces is lost in a step, which neither an edge nor a horizon stands for. And for two-sided ones: what sinks below a
    face gets inside, and out again, by way of edges that are only there for who is inside. That takes large angles,
    under a sky as well: with more than half of a body of 948 faces bent by 20 degrees, and 29 % by 35, the gain is
    0.98 +- 0.03. Mirrors, whose steps are edges, are right at 30 degrees (1.01 +- 0.01 over a floor under a sky), and
    a few % off at 55.
    """
    for mesh in [mesh for mesh in meshes if (key_of(mesh), limit) not in memory[LOOKED_AT]]:
        memory[LOOKED_AT].add((key_of(mesh), limit))
        with dr.suspend_grad():
            share = _bent_share(mesh, limit)
        if share > BENT_SHARE:
            warn_once(
                f"mesh '{shown_name(mesh)}' is shaded with normals that are more than {limit:g} degrees off its "
                "faces: where the plane of a face passes through a light or through what is lit, a step of what it "
                "reflects is missing from the derivative, and so is what gets in and out between its faces; "
                "split its normals at sharp edges, set face_normals, or use a finer mesh",
                UnsupportedWarning,
                memory,
            )


def _bent_share(mesh: mi.Mesh, limit: float) -> float:
    """Share of the area in faces of which a corner's normal is more than `limit` degrees off."""
    faces = mesh_faces(mesh)
    positions = dr.detach(mesh_positions(mesh))
    p = [dr.gather(mi.Point3f, positions, faces[k]) for k in range(3)]
    n_g = dr.cross(p[1] - p[0], p[2] - p[0])
    area = dr.norm(n_g)
    least = mi.Float(1)
    for k in range(3):
        n_s = mi.Vector3f(dr.detach(mesh.vertex_normal(faces[k])))
        least = dr.minimum(least, dr.abs(dr.dot(n_s, n_g)) / (dr.norm(n_s) * area))
    bent = dr.select(least < math.cos(math.radians(limit)), area, 0)
    return float((dr.sum(bent) / dr.sum(area))[0])
