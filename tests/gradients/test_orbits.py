"""Spheres of mirror and glass, as smooth surfaces see them: directions turn with them (`paths/orbits.py`)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward
from variants import also

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.paths.orbits import Orbit
from psdr_jit.plan.job import Job

SEEDS, SPP, REFERENCE_SPP = 8, 128, 4096
BLOCK = 8  # [px]
MOST_SIGMA = 4.5  # of a block
NOISE_BELOW = 0.2  # variance relative to that of directions that rest; 1/39 with twice the samples
TOLERANCE = 1e-4  # of the adjoint identity
CENTRE, RADIUS = (0.1, 0.85, 0.0), 0.5


def scene(material: str, res: int = 16, point: bool = False) -> mi.Scene:
    """A ball above a floor, of which the camera sees the floor alone: only by way of this it knows of the ball."""
    T = mi.ScalarTransform4f
    pose = T().translate([0.3, 1.2, -2.6]).rotate([1, 0, 0], 20).scale(0.6)
    lamp = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 4.0}}
    if point:
        lamp = {"type": "point", "position": [0.3, 1.2, -2.6], "intensity": 4.0}
    size = {"width": res, "height": res, "rfilter": {"type": "gaussian" if point else "box"}}
    above = T().look_at([0.0, 4.0, -2.2], [0.0, 0.0, -1.3], [0, 1, 0])
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 28, "to_world": above, "film": {"type": "hdrfilm", **size}},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3), "bsdf": {"type": "diffuse"}},
        "lamp": lamp,
        "ball": {"type": "sphere", "center": list(CENTRE), "radius": RADIUS, "bsdf": {"type": material}},
    })  # fmt: skip


def blocks(images: np.ndarray) -> np.ndarray:
    n, h, w, c = images.shape
    return images.reshape(n, h // BLOCK, BLOCK, w // BLOCK, BLOCK, c).mean((2, 4, 5)).reshape(n, -1)


def orbit(x: mi.Point3f, centre: mi.Point3f, ω: mi.Vector3f) -> Orbit:
    w = mi.Vector3f(centre - x)
    D = dr.norm(w)
    return Orbit(mi.Bool(True), w / D, D, ω, dr.dot(ω, w) / D)


def rays(count: int = 64) -> tuple[mi.Point3f, mi.Point3f, mi.Vector3f]:
    rng = np.random.default_rng(3)
    x = np.array([[0.4, -0.3, 1.5]]).T
    ω = np.array([CENTRE]).T - x + 0.25 * rng.normal(size=(3, count))
    return mi.Point3f(x), mi.Point3f(*CENTRE), dr.normalize(mi.Vector3f(ω))


def test_a_line_keeps_its_distance_from_the_centre(variant):
    """With δ and ρ taken for finite and small, ω + η passes the moved centre at the same share of the radius."""
    x, centre, ω = rays()
    δ, ρ = mi.Vector3f(2e-3, -1e-3, 3e-3), 2e-3
    η = orbit(x, centre, ω).turn(δ, mi.Float(ρ))

    def passes(c, r: float, d) -> np.ndarray:
        return np.array(dr.norm(dr.cross(mi.Vector3f(c - x), dr.normalize(d)))) / r

    before = passes(centre, RADIUS, ω)
    assert np.abs(passes(centre + δ, RADIUS * (1 + ρ), ω) - before).max() > 5e-4  # resting directions do not
    assert np.abs(passes(centre + δ, RADIUS * (1 + ρ), ω + η) - before).max() < 2e-5


def test_the_measure_follows_the_divergence(variant):
    """Area of a small triangle of directions, before and after."""
    x, centre, ω = rays()
    δ, ρ, h, step = mi.Vector3f(0.5, -0.3, 0.8), mi.Float(0.4), 0.02, 0.01
    frame = mi.Frame3f(ω)

    def area(scale: float) -> np.ndarray:
        corners = []
        for angle in (0.0, 2.1, 4.2):
            d = dr.normalize(ω + h * (np.cos(angle) * frame.s + np.sin(angle) * frame.t))
            corners.append(dr.normalize(d + scale * orbit(x, centre, d).turn(δ, ρ)))
        a, b, c = corners
        return np.array(dr.dot(dr.cross(b - a, c - a), dr.normalize(a + b + c)))

    found = (area(step) - area(-step)) / (2 * step * area(0.0))
    expected = np.array(orbit(x, centre, ω).stretch(δ, ρ))
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


def test_covectors_are_the_transpose(variant):
    x, centre, ω = rays()
    δ, ρ, b = mi.Vector3f(0.5, -0.3, 0.8), mi.Float(0.4), mi.Vector3f(0.2, 0.9, -0.6)
    q, s = orbit(x, centre, ω).covectors(b)
    assert np.allclose(dr.dot(q, δ) + s * ρ, dr.dot(b, orbit(x, centre, ω).turn(δ, ρ)), atol=1e-5)


MOVED, SEEN = ("ball.to_world", (0.6, 0.5, -0.4)), ("sensor.to_world", (1, 0.2, 0.4))  # the ball, the camera
PATHS = {"max_depth": 3}


@pytest.mark.parametrize(
    ("material", "motion"),
    [also("dielectric", SEEN), also("conductor", SEEN), also("conductor", MOVED)],
)
def test_differences_agree(llvm, material, motion):
    """Directions that rest miss a hundredth of the first, which then is in samples too rare to be met here."""
    param, direction = motion
    p = perturb(scene(material), param, direction=direction)
    ours = blocks(forward(p, {"type": "psdr_path", **PATHS}, SEEDS, SPP))
    theirs = blocks(fd(p, {"type": "path", **PATHS}, None, SEEDS, REFERENCE_SPP))
    errors = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / SEEDS)

    def off(factor: float) -> float:
        return (np.abs(factor * ours.mean(0) - theirs.mean(0)) / errors).max()

    assert off(1) < MOST_SIGMA
    if motion is SEEN:  # light by way of a ball that moves is little, next to the noise of differences
        assert all(off(wrong) > 3 * MOST_SIGMA for wrong in (0.0, -1.0, 0.5))


@pytest.mark.slow
def test_directions_that_turn_are_less_noisy(llvm, monkeypatch):
    p = perturb(scene("conductor"), SEEN[0], direction=SEEN[1])
    turning = blocks(forward(p, {"type": "psdr_path", **PATHS}, SEEDS, SPP))
    monkeypatch.setattr(Job, "orbits", None)
    resting = blocks(forward(p, {"type": "psdr_path", **PATHS}, SEEDS, SPP))
    assert turning.var(0, ddof=1).mean() < NOISE_BELOW * resting.var(0, ddof=1).mean()


@pytest.mark.slow
def test_light_subpaths_leave_them_what_they_are(llvm, monkeypatch):
    """Light of a point by way of the ball is found from the light, and has a flow of its own; all else turns."""
    p = perturb(scene("conductor", point=True), SEEN[0], direction=SEEN[1])
    spec = {"type": "psdr_bdpt", "max_depth": 4, "form": "spatial", "sppc": SPP, "sppp": 1, "spps": 1, "sppi": SPP}
    turning = blocks(forward(p, spec, SEEDS, 0))
    monkeypatch.setattr(Job, "orbits", None)
    resting = blocks(forward(p, spec, SEEDS, 0))
    errors = np.sqrt((turning.var(0, ddof=1) + resting.var(0, ddof=1)) / SEEDS)
    assert (np.abs(turning.mean(0) - resting.mean(0)) / errors).max() < MOST_SIGMA
    assert turning.var(0, ddof=1).mean() < NOISE_BELOW * resting.var(0, ddof=1).mean()


def test_adjoint(variant):
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 4})
    one, other, w, Jv = adjoint_identity(scene("dielectric"), "ball.to_world", integrator, spp=16)
    assert abs(one - other) < TOLERANCE * w * Jv
