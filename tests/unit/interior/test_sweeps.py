"""Both sweeps carry what a flow hands on: the point and the direction. Shown with made-up mirrors.

A path runs through tilted planes, and its direction after each of them depends on the direction before and on the
plane's tilt. No scene is needed: the sweeps know a flow's terms only.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.records import Continuation, EmitterSample, Hit, Vertex
from psdr_jit.interior.flow import Flow, VertexTerms
from psdr_jit.interior.sweeps import backward_sweep, forward_sweep
from psdr_jit.paths.recording import PathRecords
from psdr_jit.plan.motion import SceneMotion
from psdr_jit.scene import io as scene_io

ONLY_INTERIOR = {"sppp": 0, "spps": 0, "sppd": 0, "sppi": 0}

LANES, DEPTH = 4, 3
STEP = 2.0  # distance of the planes [m]


@dataclass(frozen=True)
class Mirrors(Flow):
    """Plane k, at distance (k + 1) · STEP in the z direction and tilted by θ_k, turns the ray by 2 θ_k."""

    tilt: mi.Float  # θ, one entry for each vertex
    turns: bool  # False: the outgoing direction is the recorded one, as of a smooth surface

    def terms(self, vertex, following, ray, first, moves):
        active = vertex.onward.pdf > -1  # all lanes that the sweep looks at
        θ = dr.gather(mi.Float, self.tilt, vertex.nee.prim_index, active)
        x, d = reflect(θ, vertex.hit.t, ray.o, ray.d)
        L, w = shading(x, d)
        return VertexTerms(x, d if self.turns else following.hit.d, L, w)


def reflect(θ, height, o, d):
    """Where the ray meets the plane through (0, 0, height) with the normal n(θ), and where it goes from there."""
    n = mi.Vector3f(dr.sin(θ), 0, -dr.cos(θ))
    t = dr.dot(mi.Point3f(0, 0, height) - o, n) / dr.dot(d, n)
    # the made-up mirror lets the ray through, reflected about the plane and flipped: paths go on upwards
    out = d - 2 * dr.dot(d, n) * n
    return o + t * d, mi.Vector3f(out.x, out.y, -out.z)


def shading(x, d):
    """What a vertex sends back and its factor: any functions of both."""
    L = mi.Spectrum(1 + x.x + 0.3 * dr.square(x.y), 0.5 + d.x * x.y, d.z + dr.square(d.y))
    return L, mi.Spectrum(0.5 + 0.1 * d.x, 0.6 + 0.1 * x.x, 0.7 + 0.2 * d.y * x.x)


def whole_path(tilt, o, d):
    """The radiance of the path as one expression; also the rays that reach its vertices, and throughputs."""
    L, β, rays = mi.Spectrum(0), mi.Spectrum(1), []
    for k in range(DEPTH):
        rays.append((mi.Point3f(o), mi.Vector3f(d), β))
        o, d = reflect(dr.gather(mi.Float, tilt, mi.UInt32(k)), (k + 1) * STEP, o, d)
        L_k, w_k = shading(o, d)
        L += β * L_k
        β = β * w_k
    return L, rays


def camera():
    rng = np.random.default_rng(2)
    o = mi.Point3f(rng.uniform(-1, 1, (3, LANES)) * [[1], [1], [0]])
    d = mi.Vector3f(rng.uniform(-0.2, 0.2, (3, LANES)) + [[0], [0], [1]])
    return o, dr.normalize(d)


def record(tilt):
    """Records of the same paths, as a walk would have left them; `hit.t` and `prim_index` tell the made-up plane."""
    records = PathRecords(LANES, DEPTH)
    _, rays = whole_path(dr.detach(tilt), *camera())
    for k, (o, d, β) in enumerate(rays):
        hit = Hit.made(dr.zeros, LANES)
        hit.o, hit.d, hit.t = o, d, dr.full(mi.Float, (k + 1) * STEP, LANES)
        nee = EmitterSample.made(dr.zeros, LANES)
        nee.prim_index = dr.full(mi.UInt32, k, LANES)
        ends = 0.0 if k == DEPTH - 1 else 1.0
        onward = Continuation(dr.full(mi.Float, ends, LANES), dr.ones(mi.Float, LANES), dr.zeros(mi.Bool, LANES))
        vertex = Vertex(hit, β + dr.zeros(mi.Spectrum, LANES), dr.zeros(mi.Float, LANES), nee, onward)
        dr.scatter(records.vertices, vertex, k * LANES + records.lane)
    records.count = dr.full(mi.UInt32, DEPTH, LANES)
    dr.eval(records.vertices)
    return records


def motion():
    return SceneMotion(sensor=None)  # the made-up flow asks for no displacement


def forward(turns: bool, θ_grad, o_grad, d_grad) -> np.ndarray:
    tilt = mi.Float(TILT)
    dr.enable_grad(tilt)
    dr.set_grad(tilt, θ_grad)
    with dr.suspend_grad():
        return np.array(forward_sweep(record(tilt), o_grad, d_grad, Mirrors(tilt, turns), motion())[0], dtype=float)


def backward(turns: bool, δL):
    tilt = mi.Float(TILT)
    dr.enable_grad(tilt)
    with dr.suspend_grad():
        λ = backward_sweep(record(tilt), δL, Mirrors(tilt, turns), motion())[:2]
        dr.eval(*λ)
    return np.array(dr.grad(tilt), dtype=float), *(np.array(a, dtype=float) for a in λ)


TILT = [0.1, -0.2, 0.15]


def directions():
    rng = np.random.default_rng(3)
    θ = rng.normal(size=DEPTH).astype(np.float32)
    return mi.Float(θ), *(mi.Vector3f(rng.normal(size=(3, LANES)).astype(np.float32)) for _ in range(2))


def attached_result(tilt_grad, o_grad, d_grad) -> np.ndarray:
    """The derivative of the whole expression, by Dr.Jit."""
    (o, d), tilt = camera(), mi.Float(TILT)
    dr.enable_grad(o, d, tilt)
    for variable, grad in ((o, o_grad), (d, d_grad), (tilt, tilt_grad)):
        dr.set_grad(variable, grad)
    L, _ = whole_path(tilt, o, d)
    return np.array(dr.forward_to(L), dtype=float)


def test_tangents_of_directions_are_carried(variant):
    grads = directions()
    expected = attached_result(*grads)
    assert np.allclose(forward(True, *grads), expected, rtol=1e-4, atol=1e-4)
    assert not np.allclose(forward(False, *grads), expected, rtol=1e-2, atol=1e-2), "the test shows nothing"


@pytest.mark.parametrize("turns", [True, False])
def test_backward_is_the_transpose(variant, turns):
    θ_grad, o_grad, d_grad = directions()
    δL = mi.Spectrum(np.random.default_rng(4).normal(size=(3, LANES)).astype(np.float32))
    dL = forward(turns, θ_grad, o_grad, d_grad)
    θ_adjoint, λ_o, λ_d = backward(turns, δL)
    there = float(np.sum(np.array(δL, dtype=float) * dL))
    parts = [
        np.dot(θ_adjoint, np.array(θ_grad, dtype=float)),
        np.sum(λ_o * np.array(o_grad, dtype=float)),
        np.sum(λ_d * np.array(d_grad, dtype=float)),
    ]
    scale = np.linalg.norm(np.array(δL)) * np.linalg.norm(dL)
    assert abs(there - sum(parts)) < 1e-5 * scale, (there, parts)
    assert all(abs(part) > 1e-3 * scale for part in parts), "a part that is 0 shows nothing"

# ------------------------------------------------------------------------------------------ what is left out


def test_a_last_vertex_that_sends_nothing_back_is_not_asked(llvm):
    """By lane: nothing at its end, an emitter sample there, a path that goes on, and one vertex alone, which emits."""
    records = PathRecords(4, 2)
    v = Vertex.made(dr.zeros, 8)
    v.nee.emitter = mi.UInt32([0, 0, 0, 0, 0, 7, 0, 0])  # vertex-major
    v.onward.pdf = mi.Float([1, 1, 1, 0, 0, 0, 0.5, 0])
    records.vertices, records.count = v, mi.UInt32([2, 2, 2, 1])
    assert records.scattering().numpy().tolist() == [1, 2, 2, 1]


@pytest.mark.slow
@pytest.mark.parametrize("form", ["spatial", "material"])
def test_lights_that_rest_need_no_derivative(llvm, form):
    """The plan knows that the lamp stays; the full plan does not, and finds the same gradient."""
    scene = scene_io.load_scene(scene_io.shipped_scene("cbox.xml"), res=8)
    params, key, found = mi.traverse(scene), "small-box.vertex_positions", {}
    grad_in = mi.TensorXf(np.linspace(-1, 1, 8 * 8 * 3).astype(np.float32).reshape(8, 8, 3))
    for plan in ("lean", "full"):
        integrator = mi.load_dict({"type": "psdr_path", "max_depth": 4, "plan": plan, "form": form, **ONLY_INTERIOR})
        params[key] = mi.Float(dr.detach(params[key]))
        dr.enable_grad(params[key])
        params.set_dirty(key)
        params.update()
        integrator.render_backward(scene, params, grad_in, seed=3, spp=16)
        found[plan] = np.array(dr.grad(params[key]), np.float64)
    largest = np.abs(found["full"]).max()
    assert largest > 0 and np.abs(found["lean"] - found["full"]).max() < 2e-5 * largest
