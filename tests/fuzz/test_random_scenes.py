"""Random scenes against finite differences: as many seeds as `PSDR_FUZZ_SEEDS` says, from `PSDR_FUZZ_FIRST` on."""

from __future__ import annotations

import json
import os
import pprint
from types import SimpleNamespace

import numpy as np
import pytest
from fuzz import verdict
from fuzz.bent import bent_case_of
from fuzz.build import build
from fuzz.curved import curved_case_of
from fuzz.scenes import Case, case_of
from fuzz.shrink import shrunk, simpler
from fuzz.specular import bidirectional_case_of, specular_case_of
from fuzz.verdict import NOISY, RIGHT, WRONG, Effort, Look, Outcome, compare, examine, motion_of

from psdr_jit.derivative.statistics import Gain
from psdr_jit.scene.params import find_param

FIRST = int(os.environ.get("PSDR_FUZZ_FIRST", "0"))
COUNT = int(os.environ.get("PSDR_FUZZ_SEEDS", "20"))
SHRINK_SECONDS = 180.0
#: Seeds that were wrong once: a shadow thinner than the height at which rays start; a contact on a face seen edge-on;
#: a ball that cuts into a prism, where its outline comes out of it; a coarse smooth-shaded light that turns in place
#: (warned about since); a light closer to what it shines on than a thousand times the height at which rays start;
#: the inner wall of a tube, seen past its rim and edge-on.
FOUND = (461, 509, 544, 704, 2082, 3049, 3295, 16175)
LOADED = 40  # seeds of the quick test
WITH_OUTLINES = 28  # a seed whose derivative is in its outlines, too


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(FIRST, FIRST + COUNT))
@pytest.mark.parametrize("draw", [case_of, specular_case_of, bidirectional_case_of, curved_case_of, bent_case_of],
                         ids=["smooth", "specular", "bidirectional", "curved", "bent"])
def test_a_random_scene(mono, draw, seed):
    case = draw(seed)
    outcome = examine(case)
    if not outcome.failed:
        return
    smallest = shrunk(case, lambda smaller: _same(smaller, outcome), SHRINK_SECONDS)
    pytest.fail(f"seed {seed}: {outcome.word}, {outcome.text}\n{pprint.pformat(smallest, width=120)}")


@pytest.mark.slow
@pytest.mark.parametrize("seed", FOUND)
def test_a_scene_that_was_wrong(mono, seed):
    outcome = examine(case_of(seed))
    assert not outcome.failed, outcome.text


def _same(case: Case, outcome: Outcome) -> bool:
    return examine(case).word == outcome.word


@pytest.mark.parametrize("draw", [case_of, specular_case_of, curved_case_of, bent_case_of],
                         ids=["smooth", "specular", "curved", "bent"])
def test_cases_are_always_the_same_and_load(mono, draw):
    """Also after a round trip through text, which is how a failure is reported; and no two are alike."""
    texts = [json.dumps(draw(seed)) for seed in range(LOADED)]
    assert texts == [json.dumps(draw(seed)) for seed in range(LOADED)] and len(set(texts)) == LOADED
    for text in texts:
        case = json.loads(text)
        assert find_param(build(case["scene"]), case["param"]).differentiable


def test_shrinking_leaves_what_matters():
    """As if the fault were in shadows of the first object: all else goes."""
    case = next(c for c in map(case_of, range(99)) if {"floor", "object1", "light1"} <= set(c["scene"]))
    case |= {"param": "object0.to_world", "integrator": {**case["integrator"], "max_depth": 4}}
    needed = {"object0", "floor", "camera", "light0"}

    def fails(smaller: Case) -> bool:
        return needed <= set(smaller["scene"]) and smaller["integrator"]["max_depth"] >= 2

    smallest = shrunk(case, fails, 60.0)
    assert set(smallest["scene"]) == needed | {"type"} and smallest["integrator"]["max_depth"] == 2
    assert not any(fails(smaller) for smaller in simpler(smallest))


def test_few_samples_are_compared(mono):
    case = case_of(WITH_OUTLINES)
    case["integrator"]["max_depth"] = 2
    few = Effort(seeds=2, spp=4, reference_spp=4, doublings=0, precision=1, first_seed=0)
    look = compare(motion_of(case), case, few)
    assert look.finite and look.estimate.any() and look.estimate.shape == look.reference.shape


@pytest.mark.slow
def test_a_missing_term_is_found(mono):
    """The comparison can fail: without the outlines that the sensor sees the derivative is wrong."""
    case = case_of(WITH_OUTLINES)
    case["integrator"] |= {"sppc": 1, "sppp": 0, "sppd": 1, "sppi": 1}
    quick = Effort(seeds=16, spp=256, reference_spp=512, doublings=3, precision=0.02, first_seed=0)
    assert examine(case, (quick, quick)).word == WRONG


@pytest.mark.parametrize(("gains", "word"), [
    ((1.0,), RIGHT), ((0.9, 1.0), RIGHT), ((0.9, 0.95, 1.0), RIGHT), ((0.9, 0.9, 0.9, 0.9), WRONG),
    ((0.9, 0.95, 0.965, 0.9), WRONG),  # within its errors, but no longer going away
    ((0.9, 0.9, 0.9, 1.0), NOISY),  # the small steps have not met what the large one does
])  # fmt: skip
def test_what_goes_away_with_the_step_is_the_differences(monkeypatch, gains, word):
    def look(motion, case, effort, finer=1.0) -> Look:
        found = gains[steps.index(finer)]
        return Look(Gain(found, 0.003, 0.003, 1.0, 0.01), 0.0, verdict.TOLERANCE, True, np.full(1, found), np.ones(1))

    steps = [*(verdict.FINER**i for i in range(3)), 1 / verdict.COARSER]
    monkeypatch.setattr(verdict, "compare", look)
    monkeypatch.setattr(verdict, "motion_of", lambda case: None)
    monkeypatch.setattr(verdict, "estimate_of", lambda *_: SimpleNamespace(add=lambda count: None))
    monkeypatch.setattr(verdict, "asymmetry", lambda *_: 0.0)
    assert examine({}).word == word
