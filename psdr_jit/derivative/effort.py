"""Where the next seconds of a check are best spent: on the estimate, or on the finite differences."""

from __future__ import annotations

from typing import Any

from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.statistics import gain

#: Samples per pixel that differences have at least, however short the time: with fewer, start-up is all it goes to.
FEWEST = 16


def most_useful(estimate: DerivativeSampler, reference: CentralDifference) -> Any:
    """The sampler that lowers the variance of the gain most per second."""
    f1, f2 = reference.halves
    slope = gain(estimate.images.group_means(), f1.group_means(), f2.group_means())
    if not slope.has_signal:
        return reference if reference.seconds <= estimate.seconds else estimate
    # adding one second's worth of seeds lowers a variance V after t seconds by about V / t
    by_estimate = slope.stderr_estimate**2 / estimate.seconds
    by_reference = slope.stderr_reference**2 / reference.seconds
    return estimate if by_estimate > by_reference else reference


def affordable(reference: CentralDifference, seeds: int, seconds: float) -> int:
    """Samples per pixel with which so many seeds of `reference` take no longer than `seconds`, as told by some that
    are added to it; those that it has, if they do not.
    """
    reference.add(reference.at_once)  # compiles
    compiled = reference.seconds
    reference.add(reference.at_once)
    needed = (reference.seconds - compiled) / reference.at_once * seeds
    return min(reference.spp, max(FEWEST, int(reference.spp * seconds / needed)))
