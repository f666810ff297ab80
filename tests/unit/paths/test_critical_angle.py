"""Directions near total reflection: their density, and that it bounds the derivative by an index of refraction."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.ad import tangents
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.paths.critical_angle import CriticalAngle, critical_angle
from psdr_jit.paths.scattering import PLAIN, Mixture, sample_scattering

COUNT = 1 << 18


def glass(α: float, int_ior: float = 1.5) -> mi.Scene:
    ball = {"type": "sphere", "bsdf": {"type": "roughdielectric", "alpha": α, "int_ior": int_ior, "ext_ior": 1.0}}
    scene = mi.load_dict({"type": "scene", "ball": ball}, optimize=False)
    perturb(scene, "ball.bsdf.eta").attach()
    return scene


def arrived(sin: float, below: bool) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    cos = math.sqrt(1 - sin**2)
    si.wi = mi.Vector3f(sin * 0.6, sin * 0.8, -cos if below else cos)
    si.t = dr.full(mi.Float, 1, COUNT)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    return si


def numbers(seed: int) -> tuple[mi.Float, mi.Point2f]:
    rng = np.random.default_rng(seed)
    return mi.Float(rng.random(COUNT)), mi.Point2f(rng.random(COUNT), rng.random(COUNT))


@pytest.mark.parametrize("sin, int_ior, below", [(0.6, 1.5, True), (0.75, 1.5, True), (0.7, 0.7, False)])
def test_density(variant, sin, int_ior, below):
    """Averages over samples are integrals over the density."""
    scene = glass(0.3, int_ior)
    bsdf, si = mi.BSDFPtr(scene.shapes()[0].bsdf()), arrived(sin, below)
    critical = critical_angle(scene)
    assert float(dr.max(critical.share(bsdf, si.wi))[0]) > 0
    _, u = numbers(0)
    sampled = critical.sample(bsdf, si.wi, u)
    density = np.array(critical.pdf(bsdf, si.wi, sampled))
    uniform = mi.warp.square_to_uniform_sphere(numbers(1)[1])
    q = np.array(critical.pdf(bsdf, si.wi, uniform)) * 4 * np.pi
    tests = (lambda ω: 1.0, lambda ω: np.array(ω.x), lambda ω: np.array(ω.z), lambda ω: np.array(ω.y) ** 2)
    for test in tests:
        a, b = test(sampled) * (density > 0), test(uniform) * q
        error = np.hypot(a.std(), b.std()) / np.sqrt(COUNT)
        assert abs(a.mean() - b.mean()) < 6 * error and error < 0.02
    assert (density > 0).mean() > 0.5


def relative_derivatives(scene: mi.Scene, si, mixture: Mixture, seed: int) -> np.ndarray:
    """df/dη over the density of its sample: what a path is multiplied with."""
    bsdf, ctx = mi.BSDFPtr(scene.shapes()[0].bsdf()), mi.BSDFContext()
    perturb(scene, "ball.bsdf.eta").attach()
    with dr.suspend_grad():
        s = sample_scattering(ctx, si, bsdf, *numbers(seed), mixture, True, mi.Bool(True))
    with dr.resume_grad():
        f_grad = tangents(bsdf.eval(ctx, si, s.wo, s.pdf > 0))
    return np.array(dr.select(s.pdf > 0, f_grad.x / s.pdf, 0))


@pytest.mark.parametrize("α", [0.1, 0.3])
def test_weights_are_bounded(llvm, α):
    """The same derivative of what is scattered in all, by weights a fifth as large."""
    scene, si = glass(α), arrived(0.667, True)
    mine = Mixture(critical=critical_angle(scene).of_light())
    plain, better = (np.stack([relative_derivatives(scene, si, m, k) for k in range(2)]) for m in (PLAIN, mine))
    error = np.hypot(plain.std(), better.std()) / np.sqrt(plain.size)
    assert abs(plain.mean() - better.mean()) < 6 * error
    assert np.abs(better).max() < 0.2 * np.abs(plain).max()
    assert (better**4).mean() < 0.1 * (plain**4).mean()


def test_nothing_elsewhere(llvm):
    """From outside, through the surface, where the index rests, and for another material."""
    scene = glass(0.3)
    bsdf, inside, outside = mi.BSDFPtr(scene.shapes()[0].bsdf()), arrived(0.6, True), arrived(0.6, False)
    critical = critical_angle(scene)
    assert not np.array(critical.share(bsdf, outside.wi)).any()
    through = mi.Vector3f(-inside.wi.x, -inside.wi.y, -inside.wi.z)
    assert not np.array(critical.pdf(bsdf, inside.wi, through)).any()
    diffuse = mi.load_dict({"type": "diffuse"})
    assert not np.array(critical.share(mi.BSDFPtr(diffuse), inside.wi)).any()
    resting = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": {"type": "roughdielectric"}}})
    assert critical_angle(resting) is None
    assert isinstance(critical, CriticalAngle)
