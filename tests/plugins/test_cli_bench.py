"""`psdr bench`: choosing, resuming, surviving a worker that does not, and a run in small."""

from __future__ import annotations

import argparse

import pytest

from benchmarks import accuracy, cases, methods, report, rows, run, stability
from benchmarks.suites import REFERENCE
from psdr_jit.scene import io as scene_io


def chosen(*words: str) -> list[run.Task]:
    return run.tasks(run.parser().parse_args(words))


def test_cases_and_methods_are_chosen_by_words():
    found = chosen("--suite", "accuracy", "--cases", "cbox,half", "--methods", "PSDR_P")
    assert {task.case for task in found} == {"half-plane", "cbox floating", "cbox contact", "cbox sunk"}
    assert {task.method for task in found} == {REFERENCE, "psdr_path"}, "whoever measures needs the reference"


def test_no_such_case_is_an_error(capsys):
    assert run.main(["--cases", "no such thing"]) == run.USAGE
    assert "--list" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--budget", "0"], ["--budget", "-1"], ["--out", __file__]])
def test_bad_options_are_errors_without_a_traceback(words, capsys):
    assert run.main(["--list", *words]) == run.USAGE
    assert "psdr bench: error" in capsys.readouterr().err


def test_nothing_to_report_is_an_error(tmp_path, capsys):
    assert run.main(["--report", "--out", str(tmp_path)]) == run.USAGE
    assert "no rows" in capsys.readouterr().err


def test_names_are_unique_and_quick_is_a_part():
    names = accuracy.case_names()
    assert len(set(names)) == len(names) and set(accuracy.quick_case_names()) <= set(names)
    steps = stability.case_names()
    assert len(set(steps)) == len(steps) and set(stability.quick_case_names()) <= set(steps)
    assert set(stability.METHODS) <= {method.name for method in methods.METHODS}


@pytest.mark.parametrize("case", cases.CASES, ids=lambda case: case.file_stem)
def test_cases_load(case, variant):
    assert cases.load(case, 8, **accuracy.LOAD).moves in (True, False)


def test_rows_that_exist_are_kept(tmp_path):
    rows.append(tmp_path / "accuracy.jsonl", {"case": "half-plane", "method": "prb"})
    assert run.done(tmp_path, ("accuracy", "cost")) == {run.Task("accuracy", "half-plane", "prb")}


def test_a_worker_that_ends_costs_one_row(tmp_path):
    args = argparse.Namespace(out=tmp_path, budget=0.1, variant="no_such_variant")
    with pytest.raises(Exception, match="no_such_variant"):  # the parent names the same cause
        run.run_worker("accuracy", "half-plane", ["prb"], args)
    args.variant = scene_io.DEFAULT_VARIANT
    left, failure = run.run_worker("accuracy", "no such case", ["prb", "psdr_path"], args)
    assert left == ["psdr_path"] and "status 1" in failure
    (row,) = rows.read([tmp_path / "accuracy.jsonl"])
    assert row["status"] == "cannot" and row["method"] == "prb" and row["error"] == failure


def test_a_run_in_small(tmp_path, capsys):
    words = ["--suite", "accuracy", "--cases", "half-plane", "--methods", "psdr_path,direct,finite", "--budget", "0.1"]
    assert run.main([*words, "--out", str(tmp_path)]) == run.OK
    found = rows.read([tmp_path / "accuracy.jsonl"])
    ours = next(row for row in found if row["method"] == "psdr_path")
    assert ours["status"] == "ok" and abs(ours["gain"] - 1) < 0.02 and ours["not_finite"] == 0
    cannot = next(row for row in found if row["method"].startswith("direct_projective"))
    assert cannot["status"] == "cannot" and "perspective" in cannot["error"]
    assert ours["machine"] and ours["versions"]["mitsuba"]
    count = len(found)
    assert run.main([*words, "--out", str(tmp_path)]) == run.OK
    assert len(rows.read([tmp_path / "accuracy.jsonl"])) == count, "nothing is measured twice"
    assert report.write(tmp_path) == 0
    assert (tmp_path / "charts" / "accuracy.png").stat().st_size > 10_000
    assert "half-plane" in (tmp_path / "README.md").read_text(encoding="utf-8")
