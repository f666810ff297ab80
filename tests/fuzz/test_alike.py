"""Random scenes and what looks the same: as many seeds as `PSDR_FUZZ_SEEDS` says, from `PSDR_FUZZ_FIRST` on."""

from __future__ import annotations

import os
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest
from fuzz.alike import WAYS, _judge, compare
from fuzz.build import build
from fuzz.scenes import Case, case_of
from fuzz.verdict import RIGHT, WRONG

from psdr_jit.scene.params import find_param

FIRST = int(os.environ.get("PSDR_FUZZ_FIRST", "0"))
COUNT = int(os.environ.get("PSDR_FUZZ_SEEDS", "10"))
LOADED = 60  # seeds of the quick test
WITH_OUTLINES = 28  # a seed whose derivative is in its outlines, too


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(FIRST, FIRST + COUNT))
@pytest.mark.parametrize("way", WAYS)
def test_what_looks_the_same_is_derived_alike(mono, way, seed):
    outcome = compare(case_of(seed), WAYS[way])
    assert outcome is None or not outcome.failed, outcome.text


@pytest.mark.parametrize("way", WAYS)
def test_scenes_written_anew_load(mono, way):
    """And there are some, for every way."""
    pairs = 0
    for seed in range(LOADED):
        changed = WAYS[way](deepcopy(case_of(seed)))
        if changed is not None:
            other, factor = changed
            assert find_param(build(other["scene"]), other["param"]).differentiable and factor > 0
            pairs += 1
        if pairs == 3:
            return
    assert pairs > 0


@pytest.mark.parametrize(("share", "word"), [(1.0, RIGHT), (0.9, WRONG)])
def test_images_are_compared(share, word):
    """The same image with a little noise, and one that lacks a tenth."""
    rng = np.random.default_rng(0)
    whole = rng.random((8, 8, 1)) + 1
    other, own = (SimpleNamespace(group_means=lambda a=a: a + 0.01 * rng.normal(size=(32, 8, 8, 1)))
                  for a in (share * whole, whole))  # fmt: skip
    assert _judge(other, own, 1.0)[0] == word


@pytest.mark.slow
def test_a_missing_term_is_found(mono):
    """The comparison can fail: without the outlines that the sensor sees, another scene is another one."""

    def without_outlines(case: Case) -> tuple[Case, float]:
        other = deepcopy(case)
        other["integrator"] |= {"sppc": 1, "sppp": 0, "sppd": 1, "sppi": 1}
        return other, 1.0

    assert compare(case_of(WITH_OUTLINES), without_outlines).word == WRONG
