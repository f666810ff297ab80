"""What the README says of its charts, from rows made up so that the answers are known; and which file gets what."""

from __future__ import annotations

import pytest

from benchmarks import report, sentences


def measured(case, method, family, **figures):
    start = {"bench": "accuracy", "case": case, "method": method, "family": family, "status": "ok", "gain": 1.0}
    return {**start, "cost": 1.0, "error_10s": 0.1, **figures}


def shadow_and_glass():
    return [
        measured("shadow", "psdr_path", "ours", cost=1e-3, error_10s=0.01),
        measured("shadow", "prb_projective, no guiding", "projective", cost=0.2, error_10s=0.3),
        measured("shadow", "finite differences", "other", error_10s=0.02),
        measured("glass, rough", "psdr_path", "ours", error_10s=0.5),
        measured("glass, rough", "finite differences", "other", error_10s=0.2),
        {"case": "glass, rough", "method": "prb_projective, no guiding", "status": "cannot", "error": "lamp"},
    ]


def test_accuracy_names_who_is_ahead():
    text = sentences.accuracy(shadow_and_glass())
    assert "200 times less variance x seconds (1 cases" in text and "900 times less squared error" in text
    assert "in 1 of 2 cases (ahead of it: finite differences in *glass, rough*)" in text


def test_stability_counts_what_is_off_beyond_its_error():
    start = {"sweep": "size", "status": "ok", "gain_stderr": 0.01}
    rows = [{**start, "method": "psdr_path", "value": 1, "gain": 1.06},
            {**start, "method": "psdr_path", "value": 2, "gain": 0.9},
            {**start, "method": "prb_projective, no guiding", "value": 1, "gain": 0.3},
            {**start, "method": "prb_projective, no guiding", "value": 2, "status": "cannot"}]  # fmt: skip
    text = sentences.stability(rows)
    assert "in 1 of 2 steps (not: size 2: 0.90)" in text and "`prb_projective` in 0 of 1." in text


def test_cost_compares_with_the_primal_of_the_same_step():
    def row(case, method, median, mib=1.0):
        return {"case": case, "method": method, "status": "ok", "wall_ms": {"median": median}, "peak_mib": mib}

    rows = [row("a", "path (primal)", 10), row("b", "path (primal)", 100), row("c", "psdr_path backward", 1e9),
            row("a", "psdr_path backward", 20, 7.0), row("b", "psdr_path backward", 800, 1234.0),
            row("a", "prb backward", 30)]  # fmt: skip
    text = sentences.cost(rows)
    assert "takes 4.0 times as long" in text and "(`prb` 3.0;" in text and "up to 1 200 MiB" in text


@pytest.mark.parametrize(("value", "text"), [(5123, "5 100"), (0.8664, "0.87"), (2, "2"), (1.234e7, "12 000 000")])
def test_numbers_have_two_digits_and_no_exponent(value, text):
    assert sentences.number(value) == text


def test_machines_are_named_once():
    machine, versions = {"cores": 2, "cpu": "CPU"}, {"variant": "llvm_ad_rgb"}
    row = {"date": "2026-01-02T03:04:05Z", "machine": machine, "versions": versions}
    assert sentences.machines([row, row]) == "Measured 2026-01-02 on 2 cores of CPU, llvm_ad_rgb."
    later = {**row, "date": "2026-02-03T03:04:05Z"}
    assert sentences.machines([later, row]).startswith("Measured 2026-01-02 to 2026-02-03 on")


def test_rows_of_a_gpu_are_summed_up():
    gpu = {"cores": 16, "cpu": "CPU", "gpu": "NVIDIA X, 1.2"}
    checks = [{"bench": "checks", "verdict": v, "machine": gpu} for v in ("pass", "pass", "fail")]
    costs = [{"bench": "backward_cost", "method": m, "wall_ms": {"median": t}, "settings": {"res": 8, "spp": 2}}
             for m, t in (("psdr_path, every term", 20.4), ("path (primal)", 1), ("prb", 7))]  # fmt: skip
    assert sentences.on_cuda([]) == ""
    assert "(NVIDIA X) 2 of 3 gradient checks pass." in sentences.on_cuda(checks)
    assert sentences.on_cuda(checks + costs).endswith("(8 x 8, 2 spp) takes 20 ms there (`prb` 7 ms).")
    assert sentences.place(gpu) == "an NVIDIA X and 16 cores of CPU"


def test_pictures_are_linked_from_where_the_page_is(tmp_path):
    (tmp_path / "charts").mkdir()
    (tmp_path / "charts" / "cost.png").touch()
    words = report.CHARTS["cost.png"]
    assert report.pictures(tmp_path, "cost.png", "accuracy.png") == f"![{words}](charts/cost.png)"
    assert report.pictures(tmp_path, "cost.png", at="some/where/") == f"![{words}](some/where/charts/cost.png)"


def test_no_rows_are_said():
    assert report.readme_charts([]) == report.EMPTY
