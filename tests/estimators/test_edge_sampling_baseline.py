"""The edge-sampling baseline estimates the same secondary boundary as `psdr_path`."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
import pytest
from helpers import POWER, forward, load
from problems import Problem, X

from benchmarks.baselines import edge_sampling
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import UnsupportedError
from psdr_jit.sampling.rows import WeightedRows

BLOCKER = "blocker.vertex_positions"
SPP = 512


def motion_of(scene: str, param: str) -> Perturbation:
    return perturb(load(Problem(scene, "", 0.0), res=16), param, direction=X)


def spec(max_depth: int, **budgets: int) -> dict:
    return {"type": "psdr_path", "form": "spatial", "max_depth": max_depth, "rr_depth": 100, **budgets}


def sampled(motion: Perturbation, max_depth: int, seeds: int, spp: int) -> np.ndarray:
    """Derivative images of the baseline, (seeds, H, W, C)."""
    integrator = edge_sampling.EdgeSampling(max_depth, rr_depth=100)
    sampler = DerivativeSampler(motion, integrator, 0, spp, groups=seeds)
    sampler.add(seeds)
    assert sampler.not_finite == 0 and int(integrator.stats["rejected"]) == 0
    return sampler.images.group_means()


def secondary(motion: Perturbation, max_depth: int, seeds: int) -> np.ndarray:
    """Of the baseline: equal seeds draw equal interior and primary samples, which cancel."""
    others = forward(motion, spec(max_depth, sppd=0, sppi=0), seeds, SPP)
    return sampled(motion, max_depth, seeds, SPP) - others


def reference(motion: Perturbation, max_depth: int) -> np.ndarray:
    return forward(motion, spec(max_depth, sppc=0, sppp=0), 8, 128)


def assert_agree(estimate: np.ndarray, expected: np.ndarray) -> None:
    slope = gain(estimate, expected[0::2], expected[1::2])
    assert slope.has_signal
    assert abs(slope.value - 1) < 4 * slope.stderr, slope
    for wrong in (0.0, -1.0, 0.5):
        assert abs(wrong - 1) > POWER * slope.stderr, f"no power against {wrong} times the gradient: {slope}"


@dataclass(frozen=True)
class Case:
    """What it takes to be right here, and how many seeds to be sure."""

    why: str
    scene: str
    param: str
    seeds: int


CASES = (
    Case("shadow of an edge", "area_shadow", BLOCKER, 20),
    Case("points of the light move", "area_shadow", "light.to_world", 12),
    Case("camera paths move", "constant_shadow", "camera.to_world", 4),
)


SLOW = ("points of the light move", "shadow of an edge")


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=c.why, marks=pytest.mark.slow if c.why in SLOW else ()) for c in CASES]
)
def test_first_vertex(llvm, case):
    motion = motion_of(case.scene, case.param)
    assert_agree(secondary(motion, 2, case.seeds), reference(motion, 2))


@pytest.mark.slow
def test_third_segment(llvm, monkeypatch):
    """Alone: reflected light that an edge hides, and shadows seen by way of another surface."""

    def more_of_what_moves(table):
        """Any density will do; this one takes fewer samples."""
        (kind,) = table.kinds
        weights = dr.norm(kind.rows.p1 - kind.rows.p0) * dr.select(kind.moving(), 10, 1)
        return WeightedRows().init("edge sampling", [weights])

    monkeypatch.setattr(edge_sampling, "scene_distribution", more_of_what_moves)
    motion = motion_of("constant_shadow", BLOCKER)
    added = secondary(motion, 3, 14) - secondary(motion, 2, 14)
    assert_agree(added, reference(motion, 3) - reference(motion, 2))


def test_without_motion_only_the_interior_is_left(llvm):
    """Radiance moves no edge: then scenes go through whose shadows could not be found."""
    motion = perturb(load(Problem("point_shadow", "", 0.0), res=16), "lamp.intensity.value")
    image = sampled(motion, 2, 1, 16)
    assert image.any() and np.array_equal(image, forward(motion, spec(2), 1, 16))


@pytest.mark.parametrize("scene, param, message", [
    ("point_shadow", BLOCKER, r"shadow edges of '.*' \(point\)"),
    ("spot_shadow", BLOCKER, r"\(spot\)"),
    ("directional_shadow", "blocker.to_world", r"\(directional\)"),
    ("ball_shadow", "blocker.to_world", "outlines of spheres"),
])  # fmt: skip
def test_what_it_cannot_do_is_an_error(llvm, scene, param, message):
    with pytest.raises(UnsupportedError, match=message):
        sampled(motion_of(scene, param), 2, 1, 4)
