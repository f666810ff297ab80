"""Every phenomenon of `problems.py` against central differences of Mitsuba's `path`, by z-scores of measured errors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import assert_grad_close, fd, forward, load, motion_of, spec_of
from problems import PROBLEMS, Problem

FAST = dict(seeds=16, spp=16, reference_seeds=12, reference_spp=128, max_stderr=0.06)
SLOW = dict(seeds=64, spp=64, reference_seeds=256, reference_spp=256, max_stderr=0.01)


def cases(slow: bool) -> list:
    """All problems for the thorough run, the quick ones for the default."""
    chosen = [p for p in PROBLEMS if slow or not p.slow]
    speed = [pytest.mark.slow] if slow else []

    return [pytest.param(p, id=p.id, marks=speed) for p in chosen]


def compare(p: Problem, seeds, spp, reference_seeds, reference_spp, max_stderr):
    scene = load(p)
    spec = spec_of(scene, **p.options)
    motion = motion_of(p, scene)
    estimate = forward(motion, spec, seeds, spp)
    reference = fd(motion, spec, p.eps, reference_seeds, reference_spp)
    assert_grad_close(estimate, reference, max_stderr)


@pytest.mark.parametrize("problem", cases(slow=False))
def test_fast(llvm, problem):
    compare(problem, **FAST)


@pytest.mark.parametrize("problem", cases(slow=True))
def test_thorough(variant, problem):
    compare(problem, **SLOW | {"reference_spp": SLOW["reference_spp"] * problem.fd_samples})


def test_wrong_gradients_are_rejected():
    """The comparison itself: with the noise of a real run, 0, −g, g/2, a displaced and an incomplete g all fail."""
    rng = np.random.default_rng(0)
    truth = np.zeros((32, 32, 3))
    truth[6:26, 10] = 4.0
    truth[6:26, 22] = -3.0

    def noisy(image, seed, n):
        return image + 2.0 * np.random.default_rng(seed).normal(size=(n, *image.shape))

    reference = noisy(truth, 1, 64)
    assert_grad_close(noisy(truth, 2, 32), reference, 0.05)
    missing = truth.copy()
    missing[6:26, 22] = 0
    for wrong in (0 * truth, -truth, truth / 2, np.roll(truth, 1, axis=1), missing, 1.2 * truth):
        with pytest.raises(AssertionError):
            assert_grad_close(noisy(wrong, 3, 32), reference, 0.05)
    with pytest.raises(AssertionError, match="raise"):
        assert_grad_close(truth + 100 * rng.normal(size=(32, *truth.shape)), reference, 0.05)
