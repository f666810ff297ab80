"""The notebooks run as they stand, find what they say, and what they show is small."""

from __future__ import annotations

from pathlib import Path

import pytest

import psdr_jit

FOLDER = Path(psdr_jit.__file__).parents[1] / "scenes" / "notebooks"
NAMES = ("first_gradient", "pose_from_image", "shape_from_views")
LARGEST = 250_000  # bytes, with pictures
SECONDS = 600  # a cell may take, on a busy machine; two minutes for all of them on a free one


def test_they_are_all_here_and_small():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(NAMES)
    for name in NAMES:
        path = FOLDER / f"{name}.ipynb"
        assert path.stat().st_size < LARGEST
        text = path.read_text(encoding="utf-8")
        assert not [folder for folder in ("/home/", "/root/", "/tmp/") if folder in text], "paths of a machine"


@pytest.mark.slow
@pytest.mark.parametrize("name, expected", [
    ("first_gradient", ("∂ image / ∂ small-box.vertex_positions", ">PASS<")),
    ("pose_from_image", ("finished", "initial, final, target")),
    ("shape_from_views", ("finished", "body.ply")),
])  # fmt: skip
def test_it_runs_as_it_stands(name, expected, tmp_path):
    reason = "needs the packages of the extra test: nbclient, ipykernel"
    nbclient, nbformat = (pytest.importorskip(module, reason=reason) for module in ("nbclient", "nbformat"))
    pytest.importorskip("ipykernel", reason=reason)
    if name == "shape_from_views":
        pytest.importorskip("cholespy", reason="smooth steps of vertices need the package cholespy")
    book = nbformat.read(FOLDER / f"{name}.ipynb", 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(book, timeout=SECONDS, kernel_name="python3", resources=resources).execute()
    shown = [str(data) for cell in book.cells for output in cell.get("outputs", ()) for data in
             output.get("data", {}).values()]  # fmt: skip
    for words in expected:
        assert any(words in text for text in shown), f"{name} does not show {words!r}"
    if name == "pose_from_image":
        distance, angle = (found for _, found in eval(shown[-1]).values())
        assert distance < 0.03 and angle < 3.0
