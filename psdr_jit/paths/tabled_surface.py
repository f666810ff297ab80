"""The surface of meshes and spheres, from their tables, whichever was met: no virtual call asks for it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.mesh_tables import MeshTables
from .mesh_surface import mesh_surface
from .sphere_surface import sphere_surface

#: What a shape says of its surface, beside its distance and its shading normal.
FIELDS = ("p", "n", "uv", "dp_du", "dp_dv")


def tabled_surface(
    tables: MeshTables,
    pi: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    flags: mi.RayFlags,
    active: mi.Bool | bool = True,
) -> mi.SurfaceInteraction3f:
    """`pi.compute_surface_interaction(ray, flags, active)` in a scene that has `tables`. `flags`: with `FollowShape` or
    without; not for derivatives of normals by texture coordinates (`dNSdUV`), nor for resting shapes (`DetachShape`).
    """
    follow, frames = (int(flags) & int(flag) != 0 for flag in (mi.RayFlags.FollowShape, mi.RayFlags.ShadingFrame))
    shape = dr.reinterpret_array(mi.UInt32, pi.shape)
    hit = mi.Bool(active) & pi.is_valid()
    if tables.spheres is None:
        values = mesh_surface(tables, pi, ray, flags, hit)
    else:
        round_ = hit & (dr.gather(mi.UInt32, tables.spheres.place, shape, hit) != 0)
        flat, curved = mesh_surface(tables, pi, ray, flags, hit & ~round_), sphere_surface(
            tables.spheres, pi, ray, follow, round_)  # fmt: skip
        values = {name: dr.select(round_, curved[name], value) for name, value in flat.items()}
    si = dr.zeros(mi.SurfaceInteraction3f)
    for name in FIELDS:
        setattr(si, name, dr.select(hit, values[name], 0))
    si.t = dr.select(hit, values["t"], dr.inf)
    si.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(hit, shape, 0))
    si.prim_index = mi.UInt32(pi.prim_index)
    si.time, si.wavelengths = ray.time, ray.wavelengths
    si.sh_frame.n = dr.select(hit, values["shading"], 0)
    if frames:
        si.sh_frame.s = _along(si.sh_frame.n, si.dp_du)
        si.sh_frame.t = dr.cross(si.sh_frame.n, si.sh_frame.s)
    si.wi = dr.select(hit, si.to_local(-ray.d), -ray.d)
    return si


def _along(n: mi.Normal3f, dp_du: mi.Vector3f) -> mi.Vector3f:
    """The unit vector at right angles to n that is next to ∂p/∂u; any one where that is 0."""
    unknown = dr.all(dp_du == 0)
    across = dr.select(unknown, mi.Vector3f(1, 0, 0), dr.fma(n, -dr.dot(n, dp_du), dp_du))
    return dr.select(unknown, mi.coordinate_system(n)[0], dr.normalize(across))
