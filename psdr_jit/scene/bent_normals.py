"""Bump and normal maps: which a BSDF has, and the normals they bend."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .delta_lobes import BENT_NORMALS
from .graph import child_objects, is_piecewise_constant
from .names import plugin_name


@dataclass(frozen=True)
class BentMap:
    """A bump or normal map of a BSDF, and on which sides of the surface it counts."""

    node: mi.BSDF
    mirrored: bool = False  # is the back seen as if it were the front (`twosided`)?
    front: bool = True
    back: bool = True

    @property
    def texture(self) -> mi.Texture:
        return next(child for child in child_objects(self.node) if isinstance(child, mi.Texture))

    @property
    def steps(self) -> bool:
        """Do normals step from texel to texel?"""
        return plugin_name(self.node) == "bumpmap" or is_piecewise_constant(self.texture, plugin_name(self.texture))

    def normal(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Normal3f:
        """The bent normal in the shading frame, of unit length and before Mitsuba turns those that face away from the
        viewer; attached where `si` or the texture is [Mitsuba 3.9.1, `bumpmap.cpp`, `normalmap.cpp`].
        """
        if plugin_name(self.node) == "normalmap":
            return mi.Normal3f(dr.normalize(2 * mi.Vector3f(self.texture.eval_3(si, active)) - 1))
        slope = mi.traverse(self.node)["scale"] * self.texture.eval_1_grad(si, active)
        n = si.sh_frame.n
        du, dv = (d + n * (rise - dr.dot(n, d)) for d, rise in ((si.dp_du, slope.x), (si.dp_dv, slope.y)))
        across = dr.cross(du, dv)
        across *= dr.select(dr.dot(si.n, across) < 0, -1.0, 1.0)
        return mi.Normal3f(si.to_local(dr.normalize(across)))


def bent_maps(bsdf: mi.BSDF | None) -> list[BentMap]:
    """The bump and normal maps of a BSDF; of those within one another, the outermost."""
    if not isinstance(bsdf, mi.BSDF):
        return []
    if plugin_name(bsdf) in BENT_NORMALS:
        return [BentMap(bsdf)]
    inner = [child for child in child_objects(bsdf) if isinstance(child, mi.BSDF)]
    if plugin_name(bsdf) != "twosided":
        return [found for child in inner for found in bent_maps(child)]
    alike = len(inner) == 1 or inner[0] is inner[1]
    sides = [(inner[0], True, alike)] if alike else [(inner[0], True, False), (inner[1], False, True)]
    return [replace(found, mirrored=True, front=front, back=back)
            for child, front, back in sides for found in bent_maps(child)]  # fmt: skip


def nested_maps(bent: BentMap) -> list[BentMap]:
    """The maps below a map, which bend its normals further."""
    return [found for child in child_objects(bent.node) for found in bent_maps(child)]
