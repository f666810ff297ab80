"""The rule by which a gradient passes: estimate and finite differences, collected so far, in; a verdict out.

Three numbers decide: the gain (least-squares slope against two independent halves of finite differences), the root mean
square z-score of pixel blocks, and the largest |z|. No rendering here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psdr_jit.derivative.statistics import BlockTest, Gain, GroupedImages, Unseen, block_means, block_test, gain

PASS, FAIL, INCONCLUSIVE = "pass", "fail", "inconclusive"

RMS_Z = (0.8, 1.2)      # errors that are honest give 1
MAX_Z = 6.0
SETTLED_SEEDS = 96   # from here on the scatter of block means is taken at face value
SCATTER = "blocks scatter more than their errors"
MIN_SEEDS = 32          # below, the measured standard errors are too noisy for z-scores
SURE = 4.0              # standard errors beyond which more seeds would not change a failure


@dataclass(frozen=True)
class Verdict:
    """The decision and the numbers behind it; what `judge` returns."""

    verdict: str            # pass, fail or inconclusive
    reason: str
    gain: float
    gain_stderr: float
    rms_z: float
    max_z: float
    blocks: int


def judge(d: GroupedImages, f1: GroupedImages, f2: GroupedImages, block: int, *, tolerance: float = 0.02,
          max_stderr: float = 0.007, zero_bound: float | None = None, unseen: Unseen = Unseen()) -> Verdict:
    """Apply the pass rule to images collected so far; `inconclusive` when more seeds could still decide.

    `zero_bound`: for a gradient that ought to vanish, the largest block mean [radiance per unit] accepted.
    `unseen`: errors that no scatter shows, see `block_test`.
    """
    slope = gain(d.group_means(), f1.group_means(), f2.group_means())
    halves = np.concatenate((f1.group_means(), f2.group_means()))
    test = block_test(d.group_means(), halves, block, unseen)
    decision, reason = _decide(slope, test, (d, f1, f2), block, _Rule(tolerance, max_stderr, zero_bound))
    return Verdict(decision, reason, slope.value, slope.stderr, test.rms_z, test.max_z, test.blocks)


#: Where there is nothing to compare with.
NO_SIGNAL = "finite differences cannot be told from zero"

#: What helps where noise decides.
MORE = "allow more seconds, or take fewer pixels or samples a seed"


@dataclass(frozen=True)
class _Rule:
    """What counts as right; see `check_gradient`."""

    tolerance: float
    max_stderr: float
    zero_bound: float | None


def _decide(slope: Gain, test: BlockTest, images: tuple[GroupedImages, ...], block: int,
            rule: _Rule) -> tuple[str, str]:
    """`(decision, reason)`; `images`: the estimate and two halves of finite differences."""
    seeds = min(group.total for group in images)
    if seeds < MIN_SEEDS:
        return INCONCLUSIVE, f"fewer than {MIN_SEEDS} seeds of the estimate or of a half of the differences: {MORE}"
    if rule.zero_bound is not None:
        return _judge_zero(*images, block, rule.zero_bound)
    if slope.power == 0 and not images[0].mean().any():
        return PASS, "estimate and finite differences are both exactly zero"
    if not slope.has_signal:
        if test.max_z > MAX_Z:
            return FAIL, ("finite differences vanish within their error, the estimate does not: "
                          f"max |z| {test.max_z:.1f}")
        return INCONCLUSIVE, (f"{NO_SIGNAL}; if the gradient ought to vanish, "
                              "give an absolute bound (zero_bound)")
    return _judge_gain(slope, test, seeds, rule.tolerance, rule.max_stderr)


def _slightly_scattered(test: BlockTest) -> bool:
    """Blocks are off by more than their errors, but not by so much that more seeds could not explain it."""
    off = test.max_z > MAX_Z or (np.isfinite(test.rms_z) and not RMS_Z[0] <= test.rms_z <= RMS_Z[1])
    return off and test.max_z <= 2 * MAX_Z and test.rms_z <= 2 * RMS_Z[1]


def _judge_gain(slope: Gain, test: BlockTest, seeds: int, tolerance: float, max_stderr: float) -> tuple[str, str]:
    off = abs(slope.value - 1)
    precise = slope.stderr <= max_stderr
    known = slope.stderr <= max_stderr / 2
    if off > tolerance + (0 if known else SURE * slope.stderr):
        return FAIL, f"gain is off by {off:.3f}, tolerance {tolerance:g}"
    if precise and off > tolerance:
        return INCONCLUSIVE, f"gain is off by {off:.3f} +- {slope.stderr:.4f}, not certain to exceed {tolerance:g}"
    if seeds < SETTLED_SEEDS and _slightly_scattered(test):
        # Standard errors of few, heavy-tailed samples are too small: a bias grows with more seeds, this fades.
        return INCONCLUSIVE, f"{SCATTER} (RMS z {test.rms_z:.2f}, max |z| {test.max_z:.1f})"
    if test.max_z > MAX_Z:
        return FAIL, f"a block is off by {test.max_z:.1f} standard errors, limit {MAX_Z:g}"
    if not precise:
        return INCONCLUSIVE, f"standard error of the gain is {slope.stderr:.4f}, needs {max_stderr:g}: {MORE}"
    if np.isfinite(test.rms_z) and not RMS_Z[0] <= test.rms_z <= RMS_Z[1]:
        return FAIL, f"RMS z {test.rms_z:.2f} is outside {RMS_Z[0]} to {RMS_Z[1]}"
    return PASS, f"gain within {tolerance:g}, errors as measured"


def _judge_zero(d: GroupedImages, f1: GroupedImages, f2: GroupedImages, block: int,
                bound: float) -> tuple[str, str]:
    """Both images must be small in absolute terms, and known well enough to say so."""
    outcome = PASS, f"every block mean is below {bound:g}"
    for what, images in (("estimate", d), ("finite differences", f1), ("finite differences", f2)):
        size, errors = np.abs(block_means(images.mean(), block)), images.stderr(block)
        if np.any(size > bound + SURE * errors):
            return FAIL, f"the {what} reach {size.max():.3g}, bound {bound:g}"
        if np.any(size + SURE * errors > bound):
            outcome = INCONCLUSIVE, f"the error of the {what} is {errors.max():.3g}, too large for {bound:g}"
    return outcome
