"""How the line of sight at the end of a chain moves, with the film point or with θ, and its adjoint.

A chain's segment k starts at the attached ray (o, d); the surface it meets and the delta lobe that it leaves by give
those of segment k + 1 (`paths/delta_step.py`). Forward, the tangents (ȯ, ḋ) are carried along the recorded segments;
backward, the adjoints (λ_o, λ_d) of the last line of sight are carried back to the camera ray, and what they say about
the surfaces on the way is deposited on these.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import accumulate, tangents
from ..core.counters import Counter
from ..core.records import Hit
from ..paths.delta_step import delta_step
from ..plan.motion import Displacements, Motion, SceneDisplacements
from ..scene.facts import SceneFacts
from ..scene.surfaces import Surfaces
from .chain_trace import ChainRecords


@dataclass(frozen=True)
class AtRest(Motion):
    """Nothing moves but what is asked about."""

    sensor: mi.Sensor
    surfaces: Surfaces | None

    @contextmanager
    def attached(self, *variables) -> Iterator[Displacements]:
        with dr.resume_grad():
            dr.enable_grad(*variables)
        with dr.resume_grad(*variables):
            yield SceneDisplacements(self.sensor, self.surfaces)

    def camera_tangents(self, ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        return mi.Vector3f(0), mi.Vector3f(0)


def _onward(hit: Hit, d_next: mi.Vector3f, ray: mi.Ray3f, moving: Displacements, bends: mi.Bool):
    """The attached ray `(x, d)` that leaves the surface at the end of `hit` in the direction `d_next`.

    `bends`: by a delta lobe. At smooth vertices the direction stays what it is.
    """
    si = moving.surface(hit, ray, mi.RayFlags.All)
    step = delta_step(mi.BSDFContext(), si, si.bsdf(), d_next, bends)
    return si.p, dr.select(bends, step.d, d_next)


@dr.syntax
def carry_tangents(chain: ChainRecords, last: mi.UInt32, o_grad: mi.Vector3f, d_grad: mi.Vector3f, motion: Motion):
    """Tangents `(ȯ, ḋ)` of the ray of segment `last`, given those of the camera ray. Detached."""
    k = mi.UInt32(0)
    o_grad, d_grad = mi.Vector3f(o_grad), mi.Vector3f(d_grad)
    active = k < last
    while dr.hint(active, label="psdr.chain.forward", exclude=[chain, motion]):
        hit, d_next, bends = chain.segment(k, active), chain.segment(k + 1, active).d, chain.bent(k, active)
        o, d = mi.Point3f(hit.o), mi.Vector3f(hit.d)
        with motion.attached(o, d) as moving:
            dr.set_grad(o, o_grad)
            dr.set_grad(d, d_grad)
            x, onward = _onward(hit, d_next, mi.Ray3f(o, d), moving, bends)
            x_grad, onward_grad = tangents(x, onward)
        o_grad, d_grad = mi.Vector3f(x_grad), mi.Vector3f(onward_grad)
        k += 1
        active = k < last
    return o_grad, d_grad


@dr.syntax
def carry_adjoints(chain: ChainRecords, last: mi.UInt32, λ_o: mi.Vector3f, λ_d: mi.Vector3f, motion: Motion):
    """Adjoints `(λ_o, λ_d)` of the camera ray, given those of the ray of segment `last`; θ receives its share."""
    k = mi.UInt32(last)
    λ_o, λ_d = mi.Vector3f(λ_o), mi.Vector3f(λ_d)
    active = k > 0
    while dr.hint(active, label="psdr.chain.backward", exclude=[chain, motion]):
        k -= 1
        hit, d_next, bends = chain.segment(k, active), chain.segment(k + 1, active).d, chain.bent(k, active)
        o, d = mi.Point3f(hit.o), mi.Vector3f(hit.d)
        with motion.attached(o, d) as moving:
            x, onward = _onward(hit, d_next, mi.Ray3f(o, d), moving, bends)
            dr.backward_from(dr.dot(λ_o, x) + dr.dot(λ_d, onward))
            λ_o, λ_d = mi.Vector3f(dr.grad(o)), mi.Vector3f(dr.grad(d))
        active = k > 0
    return λ_o, λ_d


def slope_at_end(facts: SceneFacts, chain: ChainRecords, end, camera: tuple, motion: Motion) -> mi.Float:
    """Tangent of F at the `end` of chains, given the tangents `camera` of their first rays. Detached.

    `end` has a `segment`, a `curve`, and an `attached_F` of the line of sight there.
    """
    o_grad, d_grad = carry_tangents(chain, end.segment, *camera, motion)
    o, d = mi.Point3f(end.curve.line.o), mi.Vector3f(end.curve.line.d)
    with motion.attached(o, d) as moving:
        dr.set_grad(o, o_grad)
        dr.set_grad(d, d_grad)
        return tangents(end.attached_F(o, d, moving, facts))


def adjoints_at_start(
    facts: SceneFacts, chain: ChainRecords, end, λ: mi.Float, motion: Motion, rejected: Counter
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Adjoints `(λ_o, λ_d)` of the first rays of chains, given those `λ` of F at their `end`; θ receives its share.

    The transpose of `slope_at_end`. What is not finite is dropped and counted before it goes on to other surfaces;
    where λ = 0 an infinite derivative does no harm, as Dr.Jit leaves out what has a gradient of 0.
    """
    o, d = mi.Point3f(end.curve.line.o), mi.Vector3f(end.curve.line.d)
    with motion.attached(o, d) as moving:
        accumulate(λ * end.attached_F(o, d, moving, facts))
        adjoints = mi.Vector3f(dr.grad(o)), mi.Vector3f(dr.grad(d))
    dr.eval(adjoints)
    λ_o, λ_d = (rejected.keep_finite(v) for v in adjoints)
    adjoints = carry_adjoints(chain, end.segment, λ_o, λ_d, motion)
    dr.eval(adjoints)  # stored, as in `interior.term`: a pose asks for each of them twelve times
    λ_o, λ_d = (rejected.keep_finite(v) for v in adjoints)
    return λ_o, λ_d
