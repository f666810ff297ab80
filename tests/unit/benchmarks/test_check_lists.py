"""The lists of checks: every case has a name of its own, and a scene with the parameter that it moves."""

from __future__ import annotations

from collections import Counter

import pytest

from benchmarks import sentences
from benchmarks.check_lists import LISTS
from benchmarks.checks import load


@pytest.mark.parametrize("name", LISTS)
def test_cases(llvm, name):
    cases = list(LISTS[name]())
    assert max(Counter(case.name for case in cases).values()) == 1
    for case in cases[:: 7 if name == "smooth" else 3]:
        motion, told = load(case)
        assert motion.name == case.motion.param and told["eps"] > 0


def row(gain: float, stderr: float, reason: str = "", verdict: str = "pass") -> dict:
    return {"settings": {"list": "smooth", "max_stderr": 0.004}, "gain": gain, "gain_stderr": stderr, "reason": reason,
            "verdict": verdict, "machine": {}, "bench": "check_lists"}  # fmt: skip


def test_what_is_not_known_does_not_count():
    noisy, zero = row(0.7, 0.1), row(0.0, 0.001, "finite differences cannot be told from zero; ...")
    said = sentences.lists_words([row(1.003, 0.002), row(0.99, 0.004, verdict="fail"), noisy, zero])
    assert "of 4 of `smooth` 2 have a standard error of at most 0.004 and are off by at most 0.010, 1 fail" in said
    assert sentences.lists_words([]) == ""


def test_rows_from_here_come_before_those_of_a_device():
    on_device = {**row(1.0, 0.001), "machine": {"gpu": "one"}}
    other = {**on_device, "settings": {"list": "patterns", "max_stderr": 0.007}}
    assert sentences.lists_anywhere([row(1.0, 0.002)], [on_device, other]) == [row(1.0, 0.002), other]
    assert "of 1 of `patterns` (on the GPU) 1 have" in sentences.lists_words([other])
