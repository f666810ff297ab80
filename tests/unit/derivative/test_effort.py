"""How many samples differences get when time is short."""

from __future__ import annotations

import pytest

from psdr_jit.derivative.effort import FEWEST, affordable


class Clocked:
    """Differences that take a tenth of a second a seed, the first as much again for its kernels."""

    at_once, spp, seconds, seeds = 1, 256, 0.0, 0

    def add(self, seeds: int) -> None:
        self.seconds += 0.1 * seeds + (0.1 if self.seeds == 0 else 0)
        self.seeds += seeds


@pytest.mark.parametrize("seconds, spp", [(10.0, 256), (1.6, 128), (0.001, FEWEST)])
def test_as_many_as_there_is_time_for(seconds, spp):
    assert affordable(Clocked(), 32, seconds) == pytest.approx(spp, abs=1)


def test_few_stay_few():
    reference = Clocked()
    reference.spp = 4
    assert affordable(reference, 32, 0.001) == 4
