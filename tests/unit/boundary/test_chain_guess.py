"""Guesses at where neighbouring chains part, against the place that halving finds."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.chain_guess import NOWHERE, Guesses
from psdr_jit.boundary.chain_outline import AnalyticShapes
from psdr_jit.boundary.chain_trace import Pair
from psdr_jit.core.memory import Memory
from psdr_jit.core.records import Hit
from psdr_jit.edges.edge_shapes import SHAPES, EdgeShapes

#: Half of the angle between the rays of a pair, and the error that a straight line may have there.
HALF, TOLERANCE = 0.02, 0.03


NAMES = ("edge", "edge against nothing", "contour of a ball", "contour of a tube", "rim of a disk", "planes that cut")


def _shapes(name: str) -> dict:
    world = mi.ScalarTransform4f()
    tilted = world.rotate([0.36, 0.8, 0.48], 35)
    far = {"type": "rectangle", "to_world": world.translate([0, 0, -4]).scale(20)}
    slope, level = (world.rotate([0, 1, 0], angle).scale(9) for angle in (25, 0))
    return {
        "edge": {"box": {"type": "cube", "to_world": tilted}, "floor": far},
        "edge against nothing": {"card": {"type": "rectangle", "to_world": tilted}},
        "contour of a ball": {"ball": {"type": "sphere"}, "floor": far},
        "contour of a tube": {"tube": {"type": "cylinder", "p0": [0, -9, 0], "p1": [0, 9, 0]}, "floor": far},
        "rim of a disk": {"disk": {"type": "disk", "to_world": tilted}, "floor": far},
        "planes that cut": {
            "slope": {"type": "rectangle", "to_world": slope},
            "floor": {"type": "rectangle", "to_world": level},
        },
    }[name]


def _ray(s: mi.Float, aim: mi.Point3f, across: mi.Vector3f) -> mi.Ray3f:
    o = mi.Point3f(0, 0, 6)
    return mi.Ray3f(o, dr.normalize(aim - o + across * (HALF * (2 * s - 1))))


def _met(scene: mi.Scene, ray: mi.Ray3f) -> tuple[Hit, np.ndarray]:
    """What is met, and a number that tells surfaces apart."""
    pi = scene.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray)
    side = dr.select(si.is_valid() & si.shape.is_mesh(), mi.UInt32(dr.round((si.n.z + 1) * 500)), 0)
    return Hit.of(ray, pi), np.array(dr.reinterpret_array(mi.UInt32, pi.shape) * 2000 + side)


@pytest.mark.parametrize("name", NAMES)
def test_guesses_are_where_halving_ends(name, llvm):
    scene = mi.load_dict({"type": "scene", **_shapes(name)})
    rng = np.random.default_rng(1)
    n = 4000
    aim = mi.Point3f(*rng.uniform(-1.6, 1.6, (2, n)), 0)
    φ = mi.Float(rng.uniform(0, 2 * np.pi, n))
    across = mi.Vector3f(dr.cos(φ), dr.sin(φ), 0)

    lo, hi = np.zeros(n, np.float32), np.ones(n, np.float32)
    (a, at_a), (b, at_b) = (_met(scene, _ray(mi.Float(s), aim, across)) for s in (lo, hi))
    for _ in range(16):
        middle = (lo + hi) / 2
        here = _met(scene, _ray(mi.Float(middle), aim, across))[1] == at_a
        lo, hi = np.where(here, middle, lo), np.where(here, hi, middle)

    pair = Pair.start()
    pair.a, pair.b = a, b
    guessed = np.array(_guesses(scene).where(pair, mi.Bool(at_a != at_b)))
    parted = at_a != at_b
    assert parted.sum() > 20
    assert np.all(guessed[~parted] == NOWHERE)
    near = np.abs(guessed - lo)[parted] < TOLERANCE
    assert near.mean() > 0.9  # of the others two curves are between the rays


def _guesses(scene: mi.Scene) -> Guesses:
    shapes = [SimpleNamespace(index=i, plugin=s.class_name().lower()) for i, s in enumerate(scene.shapes())]
    known = Memory()
    known[SHAPES] = EdgeShapes(tuple(scene.shapes()), tuple(shapes), (), ())
    job = SimpleNamespace(scene=scene, shared=known)
    return Guesses(AnalyticShapes.of(job), None, None, smooth=False)
