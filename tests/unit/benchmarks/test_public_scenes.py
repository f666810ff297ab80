"""Surveys of scenes by others: what is moved in which order, and what is said of the outcome."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from benchmarks import survey_tables
from benchmarks.public_scenes import Corpus, part_of, stored
from benchmarks.survey import COMPUTED, REFUSED, UNDECIDED, WARNED, Effort, Row


def made_up(case: str, word: str, reason: str = "", gain: float | None = None, stderr: float | None = None):
    scene, _, param = case.rpartition(": ")
    return stored(Row(scene, param, word, gain, stderr, reason, 1.0), case, Effort(40.0))


def rows():
    return [
        made_up("data/a.xml: box.to_world", COMPUTED, "gain within 0.05", 1.01, 0.02),
        made_up("data/a.xml: C:\\lamp.to_world", UNDECIDED, "fewer | seeds", 1.6, 0.2),
        made_up("lessons/b.xml: box.to_world", WARNED, "it touches\nsomething"),
        made_up("lessons/c.xml: box.to_world", REFUSED, "shape 'box' bounds a participating medium"),
        made_up("lessons/c.xml: lamp.to_world", REFUSED, "no shapes"),
    ]


def test_the_sentence_counts():
    text = survey_tables.sentence(rows())
    assert "Of 5 pairs" in text and "(data and lessons, 3 scenes)" in text
    assert "2 are computed without a warning, 1 with one, 2 are refused (1 for participating media)." in text
    assert "confirm 1 of the 2 to 5 % and contradict none; for 1 that is too short" in text
    assert "off by 3.00 of their own standard errors" in survey_tables.undecided_words(rows())


def test_the_table_has_a_line_each():
    lines = survey_tables.table(rows()).splitlines()
    assert len(lines) == 2 + len(rows())
    assert lines[3] == "| data/a.xml | C:\\lamp.to_world | undecided | 1.600 +- 0.200 | fewer \\| seeds |"
    assert lines[4].endswith("| it touches |")


def test_scenes_take_turns(tmp_path):
    files = ["one.xml", "part.xml", "two.xml"]
    for name in files:
        (tmp_path / name).touch()
    corpus = Corpus([tmp_path], 2, (0, 1))
    corpus.moved = dict(zip([tmp_path / name for name in files], (["a", "b"], [], ["c"]), strict=True))
    pairs = [(Path(name).name, param) for name, _, param in corpus.pairs()]
    assert {name for name, _ in pairs[:2]} == {"one.xml", "two.xml"} and pairs[2][0] == "one.xml"
    assert sorted(param for _, param in pairs) == ["a", "b", "c"]
    halves = [Corpus([tmp_path], 2, (k, 2)).share(files) for k in range(2)]
    assert halves == [["one.xml", "two.xml"], ["part.xml"]]


def test_what_cannot_be_loaded_moves_nothing(llvm, tmp_path, capsys):
    (tmp_path / "part.xml").write_text("<scene version='3.0.0'><shape type='nothing'/></scene>", encoding="utf-8")
    assert list(Corpus([tmp_path], 2, (0, 1)).pairs()) == []
    assert "part.xml: not loaded" in capsys.readouterr().out


def test_parts_are_told_apart():
    assert part_of("1/4") == (1, 4)
    for wrong in ("2/2", "a/b", "1"):
        with pytest.raises(argparse.ArgumentTypeError, match="K/N"):
            part_of(wrong)
