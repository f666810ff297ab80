"""Every scene file of a folder: nothing is wrong, not finite, or ends with an error that is not ours.

`PSDR_CORPUS` names the folder, by default one of our own; `PSDR_CORPUS_OUT` one for the table and the rows;
`PSDR_CORPUS_SECONDS` how long a check may take, 0 for none; `PSDR_CORPUS_MOST` how many things of a scene are moved.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from benchmarks.survey import NOT_FINITE, REFUSED, WRONG, Row, movable, shrunk, survey, table
from psdr_jit.scene import io as scene_io

OWN = Path(__file__).parent / "scenes"
FOLDER = Path(os.environ.get("PSDR_CORPUS", OWN))
SECONDS = float(os.environ.get("PSDR_CORPUS_SECONDS", "30"))  # a check
MOST = int(os.environ["PSDR_CORPUS_MOST"]) if "PSDR_CORPUS_MOST" in os.environ else None


@pytest.mark.slow
def test_scene_files(llvm, tmp_path):
    out = Path(os.environ.get("PSDR_CORPUS_OUT", tmp_path))
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    with open(out / "corpus.jsonl", "w", encoding="utf-8") as file:
        for row in survey(FOLDER, SECONDS, MOST):
            rows.append(row)
            file.write(json.dumps(row.as_dict()) + "\n")
            file.flush()
    (out / "corpus.md").write_text(table(rows) + "\n", encoding="utf-8")
    assert rows, f"{FOLDER} holds no scene file"
    bad = [row for row in rows if row.word in (WRONG, NOT_FINITE)]
    assert not bad, "\n" + table(bad)
    if FOLDER == OWN:
        assert REFUSED not in {row.word for row in rows if row.scene == "instances.xml"}


def test_what_moves_is_found(llvm):
    scene = shrunk(scene_io.load_scene(OWN / "still_life.xml"))
    assert [info.name for info in movable(scene)] == [
        "camera.to_world", "sky.to_world", "pot.vertex_positions", "floor.to_world", "lid.to_world",
    ]  # fmt: skip
    assert tuple(scene.sensors()[0].film().size()) == (24, 16)


def test_tables_say_what_was_wrong():
    row = Row("a.xml", "box.to_world", WRONG, 0.5, 0.01, "gain is off", 1.0)
    assert "| a.xml | box.to_world | wrong | 0.500 ± 0.010 | gain is off |" in table([row])
