"""Comparisons that can fail: z-scores from measured errors with a power check, and the adjoint identity."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from problems import Problem

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.scene import io as scene_io

Z_LIMIT = 6.0  # standard errors, of few samples: thousands of comparisons with heavy tails
POWER = 5.0  # standard errors by which a wrong answer must be off
TERMS = dict(integrator_specs.term_table("psdr_path"))  # term: its sample budget


# ------------------------------------------------------------------------------------------ scenes and images


def load(problem: Problem, **defaults) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{problem.scene}.xml"), **{**problem.load, **defaults})


def spec_of(scene: mi.Scene, term: str | None = None, **options) -> dict:
    """Properties of a `psdr_path` with the depths of the scene's own integrator; `term` alone if given."""
    # its own budget is named as well: one that is not set may follow another that is 0
    budgets = {budget: int(name == term) for name, budget in TERMS.items()} if term else {}
    return integrator_specs.integrator_spec(scene, "psdr_path", **budgets, **options)


def forward(motion: Perturbation, spec: dict, seeds: int, spp: int) -> np.ndarray:
    """Derivative images of independent seeds, (seeds, H, W, C)."""
    sampler = DerivativeSampler(motion, integrator_specs.build(spec), 0, spp, groups=seeds)
    sampler.add(seeds)
    assert sampler.not_finite == 0
    return sampler.images.group_means()


def fd(motion: Perturbation, spec: dict, eps: float, seeds: int, spp: int) -> np.ndarray:
    """Central differences of `path` by as many independent seeds, (seeds, H, W, C)."""
    assert seeds % 2 == 0
    difference = CentralDifference(motion, spec, 0, spp, eps, groups=seeds // 2)
    difference.add(seeds // 2)
    return np.concatenate([half.group_means() for half in difference.halves])


def images(scene: mi.Scene, spec: dict, spp: int, seeds: int, first: int = 0) -> np.ndarray:
    """Of several seeds, (seeds, H, W, C)."""
    integrator = integrator_specs.build(spec)
    rendered = [mi.render(scene, integrator=integrator, spp=spp, seed=first + k) for k in range(seeds)]
    return np.stack([integrator_specs.to_image(image) for image in rendered])


def mesh_of(points: np.ndarray, faces: np.ndarray, normals: bool = False, **props) -> mi.Mesh:
    """A mesh named "shape" with properties such as its BSDF; Mitsuba computes its `normals`, if any."""
    given = mi.Properties()
    for name, value in props.items():
        given[name] = mi.load_dict(value) if isinstance(value, dict) else value
    mesh = mi.Mesh("shape", len(points), len(faces), has_vertex_normals=normals, props=given)
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return mesh


def motion_of(problem: Problem, scene: mi.Scene) -> Perturbation:
    return perturb(scene, problem.param, **problem.how)


# ------------------------------------------------------------------------------------------ z-tests


def mean_and_error(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))


def functionals(shape: tuple[int, ...], count: int = 24) -> np.ndarray:
    """Weights (count, H, W, C) to project images on: smooth random waves, each a statement about every pixel.

    Projections have Gaussian errors; single pixels of a finite difference, where few samples cross an edge, do not.
    """
    rng = np.random.default_rng(1)
    h, w, c = shape
    y, x = np.meshgrid(np.arange(h) / h, np.arange(w) / w, indexing="ij")
    k = rng.uniform(-3, 3, (count, 2))
    phase = rng.uniform(0, 2 * np.pi, (count, 1, 1))
    wave = np.cos(2 * np.pi * (k[:, :1, None] * x + k[:, 1:, None] * y) + phase)
    return wave[..., None] * rng.normal(size=(count, 1, 1, c))


def assert_grad_close(
    estimate: np.ndarray, reference: np.ndarray, max_stderr: float = 0.03, reference_stderr: float = 0.0
) -> tuple[float, float]:
    """`estimate` (seeds, H, W, C) agrees with `reference`: the same, or one exact image (H, W, C).

    Checks the gain (slope against the reference) and `functionals`; `reference_stderr` is the accepted relative
    error of an exact reference. Shows that 0, −g and g/2 would have been rejected, and that the gain is known to
    `max_stderr`. Returns gain and error.
    """
    exact = reference.ndim == estimate.ndim - 1
    if exact:
        noise = reference_stderr * reference
        reference = np.stack([reference - noise, reference + noise])
    weights = functionals(estimate.shape[1:])
    # One half of the reference serves as the weight of the other, so that its noise is not counted as signal.
    r1, r2 = reference[0::2], reference[1::2]
    power = float(np.sum(r1.mean(0) * r2.mean(0)))
    assert power > 0, "the reference is nothing but noise: raise its spp"

    def project(images: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.tensordot(images, w, axes=images.ndim - 1)

    def slope_and_error() -> tuple[float, float]:
        value, error = mean_and_error(project(estimate, (r1.mean(0) + r2.mean(0)) / power / 2))
        noise = 0.0
        if not exact:
            noise = mean_and_error(np.concatenate([project(r1, r2.mean(0)), project(r2, r1.mean(0))]) / power)[1]
        return float(value), float(np.hypot(error, noise) + reference_stderr)

    gain, error = slope_and_error()
    assert error < max_stderr, f"gain {gain:.4f} known to {error:.4f} only: raise spp"
    scores = z_scores(estimate, reference, weights)
    text = f"gain {gain:.4f} ± {error:.4f}, largest z {np.abs(scores).max():.1f}"
    assert abs(gain - 1) < 4 * error, text
    assert np.abs(scores).max() < Z_LIMIT, text
    for wrong in (0.0, -1.0, 0.5):
        off = abs(wrong - 1) / error
        assert off > POWER, f"no power against {wrong} times the gradient: raise spp"
    return gain, error


def z_scores(estimate: np.ndarray, reference: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(⟨w, estimate⟩ − ⟨w, reference⟩) / error for each weight image."""
    axes = ([1, 2, 3], [1, 2, 3])
    d, d_error = mean_and_error(np.tensordot(estimate, weights, axes=axes))
    f, f_error = mean_and_error(np.tensordot(reference, weights, axes=axes))
    scale = np.abs(weights).sum((1, 2, 3)) * 1e-6 * np.abs(reference).max()  # rounding of float32 images
    return (d - f) / np.sqrt(d_error**2 + f_error**2 + scale**2)


def assert_image_of_path(scene: mi.Scene, spec: dict, spp: int, seeds: int, z_limit: float) -> None:
    """The image is that of `path`, and a tenth of the light would be missed."""
    limits = {key: spec[key] for key in ("max_depth", "rr_depth", "hide_emitters") if key in spec}
    path, ours = images(scene, {"type": "path", **limits}, spp, seeds, 1000), images(scene, spec, spp, seeds)
    assert np.isfinite(ours).all()
    weights = functionals(ours.shape[1:])
    assert np.abs(z_scores(ours, path, weights)).max() < z_limit
    dimmer = z_scores(0.9 * ours, path, np.ones_like(weights[:1]))
    assert np.abs(dimmer).max() > z_limit, "no power to tell a tenth of the light: raise spp"


# ------------------------------------------------------------------------------------------ adjoint identity


def dot64(a, b) -> float:
    return float(np.dot(np.array(a, dtype=np.float64).ravel(), np.array(b, dtype=np.float64).ravel()))


class Leaves:
    """The variables that a parameter depends on: itself, or the rigid motions of a pose."""

    def __init__(self, scene: mi.Scene, name: str, seed: int = 0):
        self.params = mi.traverse(scene)
        self.name = name
        self.base = dr.detach(self.params[name])
        self.pose = "Transform" in type(self.base).__name__
        rng = np.random.default_rng(seed)
        width = 4 if self.pose else int(np.prod(dr.shape(self.base)))
        self.v = rng.normal(size=width).astype(np.float32)

    def attach(self, curve: Callable | None = None):
        """Put the attached parameter into the scene; returns the leaf."""
        if self.pose:
            leaf = dr.zeros(mi.Float, 4)
            dr.enable_grad(leaf)
            t, a = (mi.Vector3f(*(dr.gather(mi.Float, leaf, i) for i in range(3))), dr.gather(mi.Float, leaf, 3))
            value = mi.Transform4f().translate(t).rotate(mi.Vector3f(0.48, 0.6, 0.64), a * 30) @ self.base
        else:
            leaf = value = type(self.base)(self.base)
            dr.enable_grad(leaf)
        self.params[self.name] = value
        self.params.set_dirty(self.name)
        self.params.update()
        return leaf

    def tangent(self, leaf):
        """`v` in the shape of the leaf."""
        if dr.is_tensor_v(leaf):
            return type(leaf)(self.v.reshape(leaf.shape))
        if dr.depth_v(leaf) == 1:
            return type(leaf)(self.v)
        return type(leaf)(*(mi.Float(x) for x in self.v.reshape(len(leaf), -1)))


def adjoint_identity(scene: mi.Scene, name: str, integrator, spp: int = 4, seed: int = 3) -> tuple[float, ...]:
    """`(⟨w, Jv⟩, ⟨Jᵀw, v⟩, ‖w‖, ‖Jv‖)` for random w and v, dots in float64."""
    leaves = Leaves(scene, name)
    leaf = leaves.attach()
    dr.set_grad(leaf, leaves.tangent(leaf))
    dr.enqueue(dr.ADMode.Forward, leaf)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    Jv = np.array(dr.detach(integrator.render_forward(scene, leaves.params, seed=seed, spp=spp)), dtype=np.float64)

    w = np.random.default_rng(7).normal(size=Jv.shape).astype(np.float32)
    leaf = leaves.attach()
    integrator.render_backward(scene, leaves.params, mi.TensorXf(w), seed=seed, spp=spp)
    JTw = dr.grad(leaf)
    return dot64(w, Jv), dot64(JTw, leaves.tangent(leaf)), float(np.linalg.norm(w)), float(np.linalg.norm(Jv))


# ------------------------------------------------------------------------------------------ kernels


def kernels_compiled(motion: Perturbation, integrator, calls: int = 8, spp: int = 16) -> list[int]:
    """How many kernels each of so many forward calls, with seeds of their own, met for the first time."""
    compiled, known = [], set()
    for seed in range(calls):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            motion.attach()
            dr.eval(integrator.render_forward(motion.scene, motion.params, seed=seed, spp=spp))
            dr.sync_thread()
            found = {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
            compiled.append(len(found - known))
            known |= found
    motion.restore()
    return compiled
