"""Covectors carried back through a glass ball, against rays traced through it in double precision."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.delta_adjoint import DeltaRecords, DeltaTurn, through_vertex
from psdr_jit.boundary.deposits import deposit
from psdr_jit.core.ad import tangents
from psdr_jit.core.records import Hit
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.plan.motion import SceneMotion

RADIUS, ETA = 0.5, 1.5
START = np.array([0.1, 0.05, -1.2])  # of the ray, on the sensor's side
BEYOND = 1.0  # distance of the edge behind the ball; longer than the way through it
STEP = 1e-5
LAST_LOBE = 1 - 2**-24  # the random number for which glass lets through


def direction() -> np.ndarray:
    d = np.array([0.1, 0.03, 1.0])
    return d / np.linalg.norm(d)


def refracted(d: np.ndarray, n: np.ndarray, ratio: float) -> np.ndarray:
    c = -n @ d
    return ratio * d + (ratio * c - np.sqrt(1 - ratio**2 * (1 - c**2))) * n


def through_ball(eta: float, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ray `(o, d)` behind the ball."""
    o, d = START, direction()
    for ratio, root in ((1 / eta, -1), (eta, 1)):
        b = d @ (o - centre)
        o = o + (-b + root * np.sqrt(b**2 - (o - centre) @ (o - centre) + RADIUS**2)) * d
        n = (o - centre) / RADIUS
        d = refracted(d, -root * n, ratio)
    return o, d


def across(at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """A unit vector across the line of sight `at`."""
    n = np.array([1.0, 0.3, 0.0])
    n -= at[1] * (n @ at[1])
    return n / np.linalg.norm(n)


def passes_by(at: tuple[np.ndarray, np.ndarray], ray: tuple[np.ndarray, np.ndarray]) -> float:
    """How far `ray` passes by the point at the distance `BEYOND` on the line of sight `at`, across it."""
    (o, d), x = ray, at[0] + BEYOND * at[1]
    return across(at) @ (o + d * ((x - o) @ at[1]) / (d @ at[1]))


def carried_back(scene: mi.Scene, at: tuple[np.ndarray, np.ndarray]) -> float:
    """The same derivative, along the scene's tangents, by covectors as `walk_to_sensor` carries them."""
    ctx, motion = mi.BSDFContext(mi.TransportMode.Importance), SceneMotion(scene.sensors()[0])
    total = 0.0
    with dr.suspend_grad():
        ray = mi.Ray3f(mi.Point3f(at[0] + BEYOND * at[1]), mi.Vector3f(-at[1]))
        pi = scene.ray_intersect_preliminary(ray)
        a = mi.Vector3f(across(at))
        b = pi.t * a
        for _ in range(2):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
            bs, _ = si.bsdf().sample(ctx, si, LAST_LOBE, mi.Point2f(0.5))
            following = si.spawn_ray(si.to_world(bs.wo))
            on_surface = deposit(a, si.n, -following.d)
            records, hit = DeltaRecords(1, 1), Hit.of(ray, pi)
            records.turns = DeltaTurn(-following.d, b, mi.Vector3f(0), mi.Float(0))
            with motion.attached() as moving:
                summand = records.motion(hit, moving) + dr.dot(on_surface, moving.of_surface(hit))
                total += tangents(summand)[0]
            turned, bent = through_vertex(None, pi, si, si.bsdf(), b, -following.d, -ray.d, mi.Bool(True))
            a, ray = a - on_surface + bent, following
            pi = scene.ray_intersect_preliminary(ray)
            b = turned + pi.t * a
    return total


@pytest.mark.parametrize("what", ["eta", "place"])
def test_through_a_ball(llvm, what):
    """The last hit in the ball is not the first one of a ray that begins far before it."""
    sphere = {"type": "sphere", "radius": RADIUS, "bsdf": {"type": "psdr_dielectric", "int_ior": ETA, "ext_ior": 1.0}}
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    scene = mi.load_dict({"type": "scene", "ball": sphere, "camera": camera}, optimize=False)
    at, x = through_ball(ETA, np.zeros(3)), np.array([1.0, 0, 0])
    if what == "eta":
        perturb(scene, "ball.bsdf.eta").attach()
        ends = [through_ball(ETA + h, 0 * x) for h in (STEP, -STEP)]
    else:
        perturb(scene, "ball.to_world", direction=tuple(x)).attach()
        ends = [through_ball(ETA, h * x) for h in (STEP, -STEP)]
    expected = (passes_by(at, ends[0]) - passes_by(at, ends[1])) / (2 * STEP)
    assert abs(carried_back(scene, at) - expected) < 1e-3 * abs(expected)
