"""Light subpaths are aimed with the density that their weights are told."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.low_discrepancy import lane_sampler
from psdr_jit.paths.light_source import light_sources

LANES, EVERYWHERE = 1 << 16, 1 << 20
AREA = 4 * 0.3**2


def sources(lamp: dict, radius: float = 0.5):
    """A light above two balls, the second half as large; returns the scene and what is traced in it."""
    scene = mi.load_dict({
        "type": "scene", "lamp": lamp,
        "one": {"type": "sphere", "radius": radius},
        "two": {"type": "sphere", "center": [2, 0, 0], "radius": radius / 2},
    }, optimize=False)  # fmt: skip
    targets = [k for k, shape in enumerate(scene.shapes()) if not shape.is_emitter()]
    return scene, light_sources(scene, [0], targets, most=8)


def area_light() -> dict:
    pose = mi.ScalarTransform4f().look_at(origin=[0, 3, 0.2], target=[0, 0, 0], up=[1, 0, 0]).scale(0.3)
    return {"type": "rectangle", "to_world": pose, "emitter": {"type": "area"}}


LAMPS = {"area": area_light, "point": lambda: {"type": "point", "position": [0.3, 3, 0.2]}}


@pytest.mark.parametrize("lamp", LAMPS)
@pytest.mark.parametrize("radius", [0.01, 0.5, 4.0])  # far and small, usual, around the light
def test_density_is_that_of_the_samples(llvm, lamp, radius):
    """E[1/p] over the sampled directions is the solid angle of the cones, or of all directions from inside a ball."""
    _, traced = sources(LAMPS[lamp](), radius)
    start = traced.sample(lane_sampler(mi.UInt32(1), dr.arange(mi.UInt32, LANES)), [])
    x = start.ray.o + start.ray.d
    E = traced.segment_density(start.emitter, start.y, start.n, start.ray.d, x, mi.Bool(True))
    E = np.array(E, dtype=np.float64)
    assert (E > 0).mean() > 0.95  # directions at a cone's rim may round to its outside
    to_pdf = 1.0 if lamp == "point" else AREA * np.abs(np.array(dr.dot(start.n, start.ray.d), dtype=np.float64))
    inverse = (1 / (E * to_pdf)[E > 0]).mean()
    if radius < 0.1:
        assert np.isclose(inverse, np.pi * radius**2 / 3**2 * (1 + 0.25 * 9 / 13), rtol=0.1)
        return

    ω = np.random.default_rng(0).normal(size=(3, EVERYWHERE))
    ω = mi.Vector3f((ω / np.linalg.norm(ω, axis=0)).astype(np.float32))
    y, n, emitter = (dr.gather(type(v), v, dr.arange(mi.UInt32, EVERYWHERE) % LANES)
                     for v in (start.y, start.n, start.emitter))  # fmt: skip
    E = np.array(traced.segment_density(emitter, y, n, ω, mi.Point3f(y) + ω, mi.Bool(True)), dtype=np.float64)
    to_pdf = 1.0 if lamp == "point" else AREA * np.abs(np.array(dr.dot(n, ω), dtype=np.float64))
    assert np.isclose(inverse, (E > 0).mean() * 4 * np.pi, rtol=0.05)
    assert np.isclose((E * to_pdf).mean() * 4 * np.pi, 1, rtol=0.05)


def test_other_lights_have_none(llvm):
    scene, traced = sources(area_light())
    segment = mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0, 0, 1), mi.Point3f(0, 0, 1)
    nothing = traced.segment_density(mi.UInt32(0), *segment, mi.Bool(True))
    unknown = traced.segment_density(mi.UInt32(99), *segment, mi.Bool(True))
    assert nothing[0] == 0 and unknown[0] == 0


def test_many_targets_share_a_ball(llvm):
    scene, _ = sources(area_light())
    targets = [k for k, shape in enumerate(scene.shapes()) if not shape.is_emitter()]
    shared = light_sources(scene, [0], targets, most=1)
    assert len(shared.targets) == 1 and float(shared.targets[0][1][0]) > 1.5
