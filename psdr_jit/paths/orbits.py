"""Mirrors and glass that are spheres, as smooth surfaces see them: directions towards them turn along with them.

The spatial form keeps the direction in which a smooth vertex x is left. If a sphere is met there, the vertex on it
slides by 1/cosθ, its normal turns, and what a delta lobe leads to moves farther with every such passage: the derivative
has heavy tails. But any smooth field of directions at x may be followed in place of resting ones. Let c be the centre
of the sphere, R its radius, D ŵ = c − x, and cosθ = ω·ŵ. Keeping the azimuth about ŵ and sinθ D/R, the distance at
which the line passes the centre,

    η(ω) = ω̇ = [ẇ (ŵ·ω) − ŵ (ẇ·ω)]/D + g (ω − ŵ/cosθ),      g = Ṙ/R − Ḋ/D,      ẇ = ċ − ẋ,      Ḋ = ŵ·ẇ,

the line meets the sphere at the same angle and is led on as before, but turned: the outline follows, and nothing
diverges there. The measure dω changes by the divergence of η, that of its first part being 0,

    div η = (g/sinθ) d(sin²θ/cosθ)/dθ = g (1 + 1/cos²θ).

The field ends with the outline: what is seen beside an edge from x moves by η on that side (`indirect_orbits.py`).

Not near the sphere, where η grows, nor in paths that leave their first vertex by a delta lobe: the lines of the chain
term are made of resting directions (`chain_fixed.py`). Surfaces with a delta lobe of their own keep directions as well,
so that two vertices tell whether there is such a field.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..scene.facts import SceneFacts, ShapeFacts
from ..scene.poses import spheres_of
from ..scene.registry import registry_values

#: Distance from the centre of a sphere beyond which directions turn with it, relative to its radius: 1/cos²θ < 6.
FAR = 1.1

#: Number of other shapes from which directions rest, in `Orbits.numbers`.
_BESIDE = 0xFFFFFFFF


@dataclass
class Orbit:
    """The sphere that a direction ω from x leads to. Detached."""

    holds: mi.Bool  # is there one, and does it carry directions along?
    ŵ: mi.Vector3f  # unit, from x to the centre
    D: mi.Float  # distance of the centre [m]
    ω: mi.Vector3f
    cos: mi.Float  # ω·ŵ

    def turn(self, δ: mi.Vector3f, ρ: mi.Float) -> mi.Vector3f:
        """η for the displacement δ of the centre against x and the relative one ρ of the radius. Linear in both."""
        g = ρ - dr.dot(self.ŵ, δ) / self.D
        turned = (δ * self.cos - self.ŵ * dr.dot(δ, self.ω)) / self.D
        return dr.select(self.holds, turned + g * self._outwards(), 0)

    def stretch(self, δ: mi.Vector3f, ρ: mi.Float) -> mi.Float:
        """div η."""
        g = ρ - dr.dot(self.ŵ, δ) / self.D
        return dr.select(self.holds, g * (1 + dr.rcp(dr.square(self.cos))), 0)

    def covectors(self, b: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
        """b·η = q·δ + s ρ: `(q, s)`."""
        s = dr.dot(b, self._outwards())
        q = (b * self.cos - self.ω * dr.dot(self.ŵ, b) - self.ŵ * s) / self.D
        return dr.select(self.holds, q, 0), dr.select(self.holds, s, 0)

    def _outwards(self) -> mi.Vector3f:
        return self.ω - self.ŵ / self.cos


@dataclass(frozen=True)
class Orbits:
    """The spheres of a scene. Host object; arrays are detached."""

    numbers: mi.UInt32  # by registry index of a shape: its place among the spheres, from 1; `_BESIDE`; else 0
    centres: mi.Point3f
    radii: mi.Float
    move: bool  # does any of them?

    @staticmethod
    def of(scene: mi.Scene, facts: SceneFacts) -> Orbits | None:
        """None where there are none, or nothing moves."""
        known = [s for s in facts.shapes if s.index >= 0]
        found = [s for s in known if _carries(s)]
        spheres = [s.index for s in found]
        if not (spheres and facts.geometry_moves):
            return None
        values = {s.index: _BESIDE for s in known if s.delta_lobes}
        numbers = registry_values(scene, values | {index: k + 1 for k, index in enumerate(spheres)})
        return Orbits(numbers, *spheres_of(scene, spheres), any(s.geometry for s in found))

    def seen(self, x: mi.Point3f, own: mi.UInt32, ω: mi.Vector3f, met: mi.UInt32, active: mi.Bool) -> Orbit:
        """What the direction ω leads to from x on the shape `own`: the shape `met`, both by `surface_code`."""
        sphere = self._number(met, active)
        active = active & (sphere > 0) & (sphere != _BESIDE) & (self._number(own, active) == 0)
        return self._orbit(sphere - 1, x, ω, active)

    def motion(self, moves, met: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Attached displacement of the centre of the sphere `met`, and the relative one of its radius: (0, 0).

        Velocities are affine in the material point: two of them on one axis tell. `moves`: `Displacements`; `met`: 0
        where there is none.
        """
        centre, radius = self._ball(self._number(met, met != 0) - 1, met != 0)
        axis = mi.Vector3f(0, 0, 1)
        one, other = (
            moves.of_surface(Hit(centre, d, radius, met, mi.UInt32(0), mi.Point2f(0))) for d in (axis, -axis)
        )
        ρ = dr.dot(one - other, axis) / (2 * dr.select(met != 0, radius, 1))
        return (one + other) / 2, ρ

    def _ball(self, k: mi.UInt32, active: mi.Bool) -> tuple[mi.Point3f, mi.Float]:
        return dr.gather(mi.Point3f, self.centres, k, active), dr.gather(mi.Float, self.radii, k, active)

    def _number(self, code: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        return dr.gather(mi.UInt32, self.numbers, code, active & (code < dr.width(self.numbers)))

    def _orbit(self, k: mi.UInt32, x: mi.Point3f, ω: mi.Vector3f, active: mi.Bool) -> Orbit:
        centre, radius = self._ball(k, active)
        w = mi.Vector3f(centre - x)
        D = dr.norm(w)
        cos = dr.dot(ω, w) / D
        holds = active & (D > FAR * radius) & (cos > 0)
        return Orbit(holds, w / D, D, ω, dr.select(holds, cos, 1))


def _carries(shape: ShapeFacts) -> bool:
    only_delta = bool(shape.delta_lobes) and not shape.bsdf_flags & int(mi.BSDFFlags.Smooth)
    return shape.plugin == "sphere" and only_delta and not shape.is_emitter
