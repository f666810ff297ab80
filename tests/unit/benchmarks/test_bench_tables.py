"""Tables of the benchmark, from rows made up so that the answers are known."""

from __future__ import annotations

import pytest

from benchmarks import tables


def row(method, family, **more):
    figures = {"gain": 1.0, "gain_stderr": 0.01, "cost": 1.0, "error_10s": 0.1, "bias2": 0.0, "bias2_stderr": 1e-6,
               "variance": 1.0, "floor": 1e-3, "seeds": 4, "seconds": {"median": 0.5}}  # fmt: skip
    start = {"bench": "accuracy", "case": "shadow", "method": method, "family": family, "status": "ok"}
    return {**start, **figures, **more}


OURS = row("psdr_path", "ours", cost=1e-3, error_10s=0.01)
CHEAP = row("prb_projective, no guiding", "projective", cost=0.2, error_10s=0.9, gain=0.2)
GOOD = row("prb_projective, small octree", "projective", cost=0.5, error_10s=0.3, gain=0.9)
CANNOT = {"bench": "accuracy", "case": "shadow", "method": "edge sampling", "status": "cannot", "error": "lamp"}


def test_the_peer_gets_its_best_configuration_among_those_that_do_the_case():
    (line,) = tables.summary([OURS, CHEAP, GOOD, CANNOT])
    assert line["does_it"] and line["cheapest"] is GOOD and line["closest"] is GOOD
    assert line["cost_ratio"] == pytest.approx(500) and line["mse_ratio"] == pytest.approx(900)


def test_a_peer_that_leaves_most_out_counts_in_the_error_only():
    (line,) = tables.summary([OURS, CHEAP])
    assert not line["does_it"] and "(200)" in tables.summary_table([line])
    both = tables.summary_words(tables.summary([OURS, GOOD]) + [line])
    assert "500 times less variance" in both and "of the 1 cases" in both
    assert tables.summary([OURS, CANNOT]) == []


def test_what_cannot_be_done_is_said():
    text = tables.accuracy_table([OURS, CANNOT])
    assert "cannot: lamp" in text and len(set(line.count("|") for line in text.splitlines())) == 1


def test_bias_is_given_only_where_it_is_seen():
    assert tables.bias(row("m", "other", bias2=0.04, bias2_stderr=1e-3)) == "2.00e-01"
    assert tables.bias(row("m", "other", bias2=-1e-5, bias2_stderr=5e-5)).startswith("< ")


def test_sweeps_mark_what_is_off_beyond_its_error():
    step = {"sweep": "size", "value": 0.1, "status": "ok", "not_finite": 0}
    assert "**" in tables.sweep_words({**step, "gain": 0.9, "gain_stderr": 0.01})
    assert tables.sweep_words({**step, "gain": 0.9, "gain_stderr": 0.06}) == "0.90+-0.06"
    assert tables.sweep_words({**step, "gain": 1.02, "gain_stderr": 0.01, "not_finite": 3}) == "1.02, 3 not finite"
    assert tables.sweep_words({**step, "status": "cannot"}) == "cannot"


def test_geometric_mean():
    assert tables.geometric_mean([1, 100]) == pytest.approx(10)
