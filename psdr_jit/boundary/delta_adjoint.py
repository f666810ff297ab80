"""Sensor subpaths through delta lobes: what a vertex does to covectors on its position and on its direction.

In travelling order, away from the sensor, a ray is displaced by û where it meets the vertex and turned by ω̇_in. The
vertex slides along it by u, its normal turns by ṅ(û) (it is another place of a curved surface), and the direction that
leaves it turns by R_ω ω̇_in + R_n ṅ (`paths/delta_step.py`). Subpaths are walked the other way, from the edge to the
sensor, and carry the covectors a on u and b on the direction that leaves:

    b_in = R_ωᵀ b,        a_in = (slide)ᵀ a + (∂n/∂û)ᵀ R_nᵀ b,        b of the next vertex: b_in + r a_in

with r the distance to it; at a smooth vertex directions are kept and b_in = 0, but for what turns together with a
sphere (`carried_along`). What the vertex' own motion adds is
b·(the direction that leaves, with the arrival fixed), taken from the record (`DeltaRecords.motion`). R and ∂n/∂û are
those of Mitsuba's own attached interactions and BSDFs.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import accumulate
from ..core.records import Hit
from ..core.surface_code import surface_code
from ..core.varying import varying
from ..paths.delta_step import delta_step
from ..paths.orbits import Orbits
from ..paths.surface_at import surface_at
from ..plan.motion import Displacements
from ..scene.surfaces import Surfaces


@dataclass
class DeltaTurn:
    """How a subpath passes a delta lobe. Detached."""

    ω_in: mi.Vector3f  # unit direction in which the vertex is reached from the sensor's side
    b: mi.Vector3f  # covector on the direction that leaves it; 0 at smooth vertices
    q: mi.Vector3f  # covector on the centre of the sphere that it is on, if directions turn with that ...
    s: mi.Float  # ... and on the relative change of its radius


class DeltaRecords:
    """The turns of `lanes` subpaths, vertex-major as in `SubpathRecords`; not a PyTree, so never loop state."""

    BYTES = 4 * 10  # of one vertex

    def __init__(self, lanes: int, depth: int):
        size = lanes * depth
        self.stride, self.lane = varying(mi.UInt32, lanes), dr.arange(mi.UInt32, lanes)
        zeros = [dr.zeros(mi.Vector3f, size) for _ in range(3)]
        self.turns = DeltaTurn(*zeros, dr.zeros(mi.Float, size))
        self.leaves = dr.zeros(mi.Bool, lanes)  # by lane: does the path leave its first vertex by a delta lobe?
        self.mirrored = dr.zeros(mi.Bool, lanes)  # by one that reflects?
        dr.make_opaque(self.turns, self.leaves, self.mirrored)

    def write(self, k: mi.UInt32, turn: DeltaTurn, delta: mi.Bool, through: mi.Bool, active: mi.Bool) -> None:
        """`delta`: by such a lobe, which leads `through` the surface or reflects."""
        dr.scatter(self.turns, turn, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)
        first = active & (k == 0)
        dr.scatter(self.leaves, delta, self.lane, first, mode=dr.ReduceMode.Permute)
        dr.scatter(self.mirrored, delta & ~through, self.lane, first, mode=dr.ReduceMode.Permute)

    def ball_motion(self, hit: Hit, moving: Displacements, orbits: Orbits) -> mi.Float:
        """Attached q·(centre) + s·(radius) of the spheres that the vertices `hit` are on (flat arrays)."""
        t = self.turns
        active = dr.any(t.q != 0) | (t.s != 0)
        centre, radius = orbits.motion(moving, dr.select(active, hit.shape, 0))
        return dr.select(active, dr.dot(t.q, centre) + t.s * radius, 0)

    def motion(self, hit: Hit, moving: Displacements) -> mi.Float:
        """Attached b·(direction that leaves), the arrival fixed, of every vertex `hit` (flat arrays)."""
        t = self.turns
        active = dr.any(t.b != 0)
        x = hit.o + hit.t * hit.d
        r = lead(x)
        there = Hit(x - r * t.ω_in, t.ω_in, r, hit.shape, hit.prim_index, hit.prim_uv)
        there.shape = dr.select(active, hit.shape, 0)
        si = moving.surface(there, mi.Ray3f(there.o, there.d), mi.RayFlags.All)
        step = delta_step(mi.BSDFContext(), si, si.bsdf(), -hit.d, active)
        return dr.select(active, dr.dot(t.b, step.d), 0)


def lead(x: mi.Point3f) -> mi.Float:
    """Distance before the vertex x from which a ray meets nothing else first, as far as ray offsets go [m].

    Mitsuba's spheres and cylinders take the motion of the *first* hit of a ray for that of any.
    """
    return mi.math.RayEpsilon * (1 + dr.max(dr.abs(x)))


def carried_along(
    orbits: Orbits | None, ray: mi.Ray3f, end, sphere, b: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:
    """What turns the direction in which the `sphere` is seen from the `end` of `ray` (intersections), b being the
    covector on it: `(q, s)` of its centre and radius (`paths/orbits.py`); the motion of who sees it has −q.
    """
    if orbits is None:
        return mi.Vector3f(0), mi.Float(0)
    # that end may have delta lobes, by which directions follow from the arrival
    return orbits.seen(ray(end.t), surface_code(end), -ray.d, surface_code(sphere), active).covectors(b)


def through_vertex(
    surfaces: Surfaces | None,
    pi: mi.PreliminaryIntersection3f,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    b: mi.Vector3f,
    ω_in: mi.Vector3f,
    ω_out: mi.Vector3f,
    delta: mi.Bool,
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """`(b_in, (∂n/∂û)ᵀ R_nᵀ b)` of a covector `b` on ω_out, both 0 where the lobe is not `delta`. Detached."""
    with dr.resume_grad():
        n, ω = mi.Vector3f(si.sh_frame.n), mi.Vector3f(ω_in)
        dr.enable_grad(n, ω)
    with dr.resume_grad(n, ω):
        reached = mi.SurfaceInteraction3f(si)
        reached.sh_frame = mi.Frame3f(mi.Normal3f(n))
        reached.wi = reached.to_local(-ω)
        step = delta_step(mi.BSDFContext(), reached, bsdf, ω_out, delta)
        accumulate(dr.select(delta, dr.dot(b, step.d), 0))  # what is behind a mask alone is seen straight through it
        b_in, b_n = mi.Vector3f(dr.grad(ω)), mi.Vector3f(dr.grad(n))
    with dr.resume_grad():
        û = mi.Vector3f(0, 0, 0) + dr.zeros(mi.Vector3f, dr.width(b))
        dr.enable_grad(û)
    with dr.resume_grad(û):
        near = mi.PreliminaryIntersection3f(pi)
        near.t = lead(si.p)
        ray = mi.Ray3f(si.p - near.t * ω_in + û, ω_in)
        there = surface_at(surfaces, near, ray, mi.RayFlags.All, delta)
        accumulate(dr.select(delta, dr.dot(b_n, there.sh_frame.n), 0))  # flat faces do not bend
        bent = mi.Vector3f(dr.grad(û))
    return dr.select(delta, b_in, 0), dr.select(delta, bent, 0)
