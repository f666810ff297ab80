"""The interior term's derivative from recorded paths: one sweep away from the sensor, one back to it.

What the vertices of a path do while θ changes is a `Flow` (`flow.py`): it turns the attached ray that reaches vertex k
into the attached ray (x_k, d_k) that leaves it, and into what the vertex sends back, Lo_k = L_k + w_k · Lo_{k+1}.

Forward mode walks away from the sensor and carries the tangents (ȯ, ḋ) of the ray and β̇ of the throughput,

    dL += β̇_k L_k + β_k L̇_k,        β̇_{k+1} = β̇_k w_k + β_k ẇ_k,        (ȯ, ḋ)_{k+1} = (ẋ_k, ḋ_k)

Backward mode walks back and carries the adjoints (λ_o, λ_d) of the ray, and the radiance of the rest of the path: it is
the gradient of δL β_k Lo_k + λ_o·x_k + λ_d·d_k at every vertex. Both replay the same recorded vertices
(`paths/recording.py`) and ask the same flow, so they agree to rounding, and neither traces a ray.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.ad import tangents
from ..paths.recording import PathRecords
from ..plan.motion import Motion
from .flow import Flow


@dr.syntax
def backward_sweep(records: PathRecords, δL: mi.Spectrum, flow: Flow, motion: Motion):
    """Accumulate ⟨δL, dL⟩ into the scene's parameters; returns the adjoints of the camera rays and what these bring,
    `(λ_o, λ_d, L)`.

    `δL`: adjoint of each path's radiance, detached.
    """
    k = mi.UInt32(flow.vertices(records))
    rest = mi.Spectrum(0)  # radiance that the next vertex sends back, without its own emission
    λ_o = mi.Vector3f(0)
    λ_d = mi.Vector3f(0)
    active = k > 0
    while dr.hint(active, label="psdr.interior.backward", exclude=[flow, motion]):
        k -= 1
        v = records.vertex(k, active)
        following = records.arrival(k + 1, active & v.onward.goes_on())
        at = records.place(k, active)
        o, d = mi.Point3f(v.hit.o), mi.Vector3f(v.hit.d)
        with motion.attached(o, d) as moving:
            t = flow.terms(v, following, mi.Ray3f(o, d, 0, records.wavelengths), at, moving)
            Lo = t.L + t.w * rest
            dr.backward_from(dr.sum(δL * v.β * Lo) + dr.dot(λ_o, t.x) + dr.dot(λ_d, t.d))
            λ_o = mi.Vector3f(dr.grad(o))
            λ_d = mi.Vector3f(dr.grad(d))
        rest = dr.detach(Lo)
        active = k > 0
    return λ_o, λ_d, rest


@dr.syntax
def forward_sweep(records: PathRecords, o_grad: mi.Vector3f, d_grad: mi.Vector3f, flow: Flow, motion: Motion):
    """`(dL, L)` of each path: derivative of its radiance, given the tangents `(ȯ, ḋ)` of its camera ray, and itself.

    Detached.
    """
    k = mi.UInt32(0)
    dL = mi.Spectrum(0)
    L = mi.Spectrum(0)
    β_grad = mi.Spectrum(0)
    o_grad = mi.Vector3f(o_grad)
    d_grad = mi.Vector3f(d_grad)
    count = flow.vertices(records)
    active = k < count
    while dr.hint(active, label="psdr.interior.forward", exclude=[flow, motion]):
        v = records.vertex(k, active)
        following = records.arrival(k + 1, active & v.onward.goes_on())
        at = records.place(k, active)
        o, d = mi.Point3f(v.hit.o), mi.Vector3f(v.hit.d)
        with motion.attached(o, d) as moving:
            dr.set_grad(o, o_grad)
            dr.set_grad(d, d_grad)
            t = flow.terms(v, following, mi.Ray3f(o, d, 0, records.wavelengths), at, moving)
            # x is an input of L: keep the gradients of interior nodes until they have been read
            L_grad, w_grad, x_grad, onward_grad = tangents(t.L, t.w, t.x, t.d)
        dL += β_grad * dr.detach(t.L) + v.β * L_grad
        L += v.β * dr.detach(t.L)
        β_grad = β_grad * dr.detach(t.w) + v.β * w_grad
        o_grad = mi.Vector3f(x_grad)
        d_grad = mi.Vector3f(onward_grad)
        k += 1
        active = k < count
    return dL, L
