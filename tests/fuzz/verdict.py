"""Is the derivative of a case right? Against central differences, at five standard errors, in up to three looks.

The first look is cheap. What it suspects is looked at again with independent seeds, more of them, and a smaller step,
and once more with a still smaller one, at which what was off must have shrunk, too. Only what is off then counts: a
hundred seeds with some forty comparisons each give no false alarm, nor does what differences leave out between their
steps. The smaller the step, the rarer the paths that it changes: those behind a mask that meet a small lamp by chance,
say, and differences that have not met any look certain. A last look takes a larger step, and must find it off as well.

Where the image has a kink at the scene as it is (surfaces that touch, a corner that appears), the differences to either
side disagree however small the step is: there is no derivative to be wrong about.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from fuzz.build import build

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.statistics import Gain, Unseen, block_means, block_test, gain
from psdr_jit.errors import PsdrError, UnsupportedWarning

RIGHT, WRONG, KINK, NOISY, WARNED, REFUSED = (
    "right", "wrong", "no definite derivative", "too noisy", "warned", "refused",
)  # fmt: skip

VARIANT = "llvm_ad_mono"  # half the work of RGB, and all that moves is the same
SURE = 5.0  # standard errors
TOLERANCE = 0.02  # of the gain, and of the largest block: what finite steps leave
BLOCK = 4  # [px]
KNOWN_ENOUGH = 0.1  # standard error of a gain that could still tell half of the derivative from all of it
GROUPS = 32  # of seeds, from whose scatter errors are measured
FINER = 3.0  # by how much each further look's step is smaller
COARSER = 5.0  # by how much the last look's step is larger than the first's
STEP_SHARE = 0.5  # of what was off, at most left by a third look that believes the step to be the cause
MORE = 16  # times the samples, where the noise of a third look hides whether it is so
KINK_SHARE = 0.5  # of the differences' asymmetry that a smaller step must leave; that of a smooth image goes with it


@dataclass(frozen=True)
class Effort:
    """What a look starts with, and how often it may double the noisier side; those of differences count per half."""

    seeds: int
    spp: int
    reference_spp: int
    doublings: int
    precision: float  # standard error of the gain that is enough
    first_seed: int


FIRST = Effort(seeds=8, spp=128, reference_spp=512, doublings=3, precision=0.02, first_seed=0)
SECOND = Effort(seeds=16, spp=256, reference_spp=1024, doublings=4, precision=0.006, first_seed=1000)
THIRD = replace(SECOND, doublings=5, first_seed=5000)
LAST = replace(SECOND, reference_spp=8192, first_seed=9000)


@dataclass(frozen=True)
class Look:
    """What one comparison found."""

    slope: Gain
    largest_z: float  # of the blocks, with the tolerance among their errors
    tolerance: float
    finite: bool
    estimate: np.ndarray  # block means (h, w, C)
    reference: np.ndarray

    @property
    def wrong(self) -> bool:
        off = self.slope.has_signal and abs(self.slope.value - 1) > self.tolerance + SURE * self.slope.stderr
        return bool(off or self.largest_z > SURE or not self.finite)

    @property
    def blind(self) -> bool:
        """Nothing was seen that could have been missing."""
        seen = self.slope.has_signal and self.slope.stderr < KNOWN_ENOUGH
        return not seen and bool(self.estimate.any() or self.reference.any())

    @property
    def off(self) -> float:
        """The largest difference of a block."""
        return float(np.abs(self.estimate - self.reference).max())

    def __str__(self) -> str:
        return f"gain {self.slope.value:.3f} +- {self.slope.stderr:.3f}, largest |z| of blocks {self.largest_z:.1f}"


@dataclass(frozen=True)
class Outcome:
    word: str
    text: str
    seconds: float

    @property
    def failed(self) -> bool:
        return self.word in (WRONG, REFUSED)


def examine(case: Mapping[str, Any], efforts: Sequence[Effort] = (FIRST, SECOND, THIRD)) -> Outcome:
    """Look at a case once, and again with smaller steps as long as it seems wrong."""
    start = time.perf_counter()
    word, text = _examine(case, *efforts)
    return Outcome(word, text, time.perf_counter() - start)


def _examine(case: Mapping[str, Any], first: Effort, *others: Effort) -> tuple[str, str]:
    motion = motion_of(case)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UnsupportedWarning)
        try:
            estimate_of(motion, case, first).add(1)
        except PsdrError as error:
            return REFUSED, str(error)
        missing = [str(w.message) for w in said if issubclass(w.category, UnsupportedWarning)]
        missing = [text for text in missing if not any(part in text for part in case.get("accepted", ()))]
        if missing:
            return WARNED, missing[0]
        look = compare(motion, case, first)
    if not look.wrong:
        return (NOISY if look.blind else RIGHT), str(look)
    before, earlier, suspected = str(look), np.inf, np.inf
    for number, effort in enumerate(others, 1):
        look = compare(motion, case, effort, FINER**number)
        if not look.wrong and look.off < STEP_SHARE * suspected:
            return RIGHT, f"{look}, after {before}"
        before, earlier, suspected = f"{look}, after {before}", suspected, look.off
    if not look.wrong:  # its noise may be as large as what was to go away
        look = compare(motion, case, replace(effort, reference_spp=MORE * effort.reference_spp), FINER**number)
        if not look.wrong and look.off < STEP_SHARE * earlier:
            return RIGHT, f"with more samples {look}, after {before}"
    coarse = compare(motion, case, LAST, 1 / COARSER)
    if not coarse.wrong:
        return NOISY, f"by a larger step {coarse}, after {before}"
    share = asymmetry(motion, case, others[0])
    word = KINK if share > KINK_SHARE else WRONG
    return word, f"{before}; a smaller step leaves {share:.2f} of the differences' asymmetry"


def motion_of(case: Mapping[str, Any]) -> Perturbation:
    return perturb(build(case["scene"]), case["param"], **case["how"])


def compare(motion: Perturbation, case: Mapping[str, Any], effort: Effort, finer: float = 1.0) -> Look:
    """Derivative and differences of `motion`, by independent seeds."""
    estimate = estimate_of(motion, case, effort)
    reference = _differences(motion, case, effort, finer)
    for sampler in (estimate, reference):
        sampler.add(effort.seeds)
    for _ in range(effort.doublings):
        slope = gain(estimate.images.group_means(), *(half.group_means() for half in reference.halves))
        if slope.has_signal and slope.stderr < effort.precision:
            break
        if not slope.has_signal and reference.seeds > effort.seeds:
            break  # a derivative of 0, or one that would take too long
        by_estimate = slope.has_signal and slope.stderr_estimate > slope.stderr_reference
        sampler = estimate if by_estimate else reference
        sampler.add(sampler.seeds)
    d, halves = estimate.images.group_means(), [half.group_means() for half in reference.halves]
    f = np.concatenate(halves)
    size = np.abs(block_means(f.mean(0), BLOCK)).max()
    floor = np.hypot(reference.floor(BLOCK), TOLERANCE * size / SURE)
    z = block_test(d, f, BLOCK, Unseen(floor, reference.rare(BLOCK))).max_z
    blocks = (block_means(d.mean(0), BLOCK), block_means(f.mean(0), BLOCK))
    return Look(gain(d, *halves), z, TOLERANCE, estimate.not_finite == 0, *blocks)


def estimate_of(motion: Perturbation, case: Mapping[str, Any], effort: Effort) -> DerivativeSampler:
    """Nothing is rendered yet."""
    integrator = integrator_specs.build(case["integrator"])
    return DerivativeSampler(motion, integrator, 0, effort.spp, groups=GROUPS, first_seed=effort.first_seed)


def _differences(motion: Perturbation, case: Mapping[str, Any], effort: Effort, finer: float) -> CentralDifference:
    """Nothing is rendered yet."""
    options = (case["integrator"], 0, effort.reference_spp)
    return CentralDifference(motion, *options, CentralDifference(motion, *options).eps / finer, groups=GROUPS)


def asymmetry(motion: Perturbation, case: Mapping[str, Any], effort: Effort) -> float:
    """What is left of the difference between the derivatives to either side, where the step is `FINER` times smaller.

    That of a twice differentiable image shrinks with the step, that of a kink stays; 0 where noise hides it.
    """
    norms = []
    for finer in (1.0, FINER):
        eps = CentralDifference(motion, case["integrator"]).eps / finer
        one_sided = []
        for side in (1, -1):
            # a central difference about the middle of a step to that side
            shifted = replace(motion, curve=lambda theta, shift=side * eps / 2: motion.curve(theta + shift))
            one_sided.append(_differences(shifted, case, effort, 2 * finer))
            one_sided[-1].add(4 * effort.seeds)
        # independent halves: their product has no bias by noise
        halves = [a.group_means() - b.group_means() for a, b in
                  zip(one_sided[0].halves, one_sided[1].halves, strict=True)]  # fmt: skip
        squared = gain(halves[0], *halves)
        norms.append(np.sqrt(squared.power) if squared.has_signal else 0.0)
    return norms[1] / norms[0] if norms[0] > 0 else 0.0
