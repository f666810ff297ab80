"""What a sphere or cylinder of mirror or glass shows at its outline, where it is met edge-on.

Steps are looked at a little beside an edge. A distance s inside of the outline of a sphere of radius R, its surface is
met at the cosine c = √(2 s/R), which falls much more slowly than s: what is 10⁻⁴ R off the outline is met at .014. Most
surfaces are the same there, but smooth glass with its reflectance 1 − O(c) (Fresnel) has left the limit 1 by 7 % then.
The interior term has the whole fall from 1, up to where it ends (`GRAZING`); a step with less than the limit
would have a part of it twice. So walks from beside an edge meet such a surface at that cosine.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..scene.facts import SceneFacts
from ..scene.registry import registry_table

#: Cosine of arrival below which a vertex has no derivative. A sliding vertex moves by 1/cosθ, and at the outline of a
#: sphere the rounding of float32 makes any cosine below this one. Costs that share of what is smooth near an outline.
GRAZING = 5e-4

#: Shapes without triangles that are met edge-on at their outlines.
ROUND = ("sphere", "cylinder")

#: Cosine up to which a ray from beside an edge is taken to meet an outline: .00125 of the radius.
BESIDE = 0.05


@dataclass(frozen=True)
class EdgeOn:
    """The shapes of a scene of which this is so. Host object."""

    shapes: mi.UInt32  # by registry index: 1 if it is one of them

    @staticmethod
    def of(scene: mi.Scene, facts: SceneFacts) -> EdgeOn | None:
        """None where there are none."""
        found = {s.index for s in facts.shapes if s.index >= 0 and s.plugin in ROUND and s.delta_lobes}
        return EdgeOn(registry_table(scene, found)) if found else None

    def at_limit(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """`si`, which a ray along `d` meets, with the normal of the outline where it lies on one. Detached.

        What is mirrored there then goes straight on, by 2 `GRAZING` radians.
        """
        code = dr.reinterpret_array(mi.UInt32, si.shape)
        cos = dr.dot(si.sh_frame.n, -d)
        at_outline = active & si.is_valid() & (dr.abs(cos) < BESIDE)
        at_outline &= dr.gather(mi.UInt32, self.shapes, code, at_outline & (code < dr.width(self.shapes))) != 0
        across = dr.normalize(si.sh_frame.n + cos * d)
        n = mi.Normal3f(dr.sqrt(1 - GRAZING**2) * across - dr.mulsign(GRAZING, cos) * d)
        si.n = dr.select(at_outline, dr.mulsign(mi.Float(1), dr.dot(si.n, n)) * n, si.n)
        si.sh_frame = dr.select(at_outline, mi.Frame3f(n), si.sh_frame)
        si.wi = dr.select(at_outline, si.to_local(-d), si.wi)
        return si
