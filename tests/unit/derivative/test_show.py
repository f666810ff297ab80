"""Results in notebooks: figures, pictures, nothing of a name taken for markup; bars only where one looks."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from psdr_jit.core import progress
from psdr_jit.derivative.check import CheckResult
from psdr_jit.derivative.gradient import GradientResult
from psdr_jit.derivative.verdict import Verdict
from psdr_jit.inverse.loop import Result
from psdr_jit.plan.plan import EdgeCount, Plan, TermPlan

PNG = b"\x89PNG"


def gradient_result(**changes) -> GradientResult:
    image = np.random.default_rng(1).normal(size=(4, 5, 3))
    given = dict(primal=abs(image), total=image, total_stderr=0 * image + 0.25, rejected=0,
                 terms={"interior": image, "chain": 0 * image}, spp=16, seeds=4, seconds=1.5,
                 term_stderr={"interior": 0 * image + 0.125, "chain": 0 * image}, param="a<b>.to_world",
                 direction="rotation about (0, 1, 0), per radian",
                 integrator={"type": "psdr_path"})  # fmt: skip
    return GradientResult(**{**given, **changes})


def test_gradient_shows_every_term_with_its_error():
    shown = gradient_result()
    html = shown._repr_html_()
    assert shown._repr_png_().startswith(PNG)
    assert "a&lt;b&gt;.to_world" in html and "a<b>" not in html
    assert all(text in html for text in ("total", "interior", "chain", "2.5e-01", "1.2e-01", "4 seeds × 16 spp"))


def test_unknown_errors_are_no_numbers():
    image = np.full((4, 5, 3), np.nan)
    html = gradient_result(seeds=1, total_stderr=image, terms={}, term_stderr={})._repr_html_()
    assert "nan" not in html.lower().split("base64", 1)[0] and ">–<" in html


@pytest.mark.parametrize("verdict, colour", [("pass", "good"), ("fail", "bad"), ("inconclusive", "open")])
def test_check_shows_its_verdict(verdict, colour):
    image = np.ones((4, 4, 3))
    decided = Verdict(verdict, "because", 0.99, 0.01, 1.0, 3.2, 16)
    check = CheckResult(decided, 32, 64, 8, 16, 1e-3, 1, 2.0, ("interior",), "p", "its value", image, image)
    html = check._repr_html_()
    assert f'psdr-{colour}">{verdict.upper()}' in html and "0.9900 ± 0.0100" in html and "because" in html


def test_plan_shows_reasons():
    terms = (TermPlan("primary", True, "outlines move", 8, ("a",), 40, EdgeCount(3, 9, "the others rest")),
             TermPlan("chain", False, "no mirror", 0, (), 0))  # fmt: skip
    html = Plan("spatial", "why so", "equal", terms, True)._repr_html_()
    expected = ("spatial form: why so", "outlines move; 3 of 9 edges, the others rest", "no mirror")
    assert all(text in html for text in expected)


def test_optimisation_shows_losses_and_the_strip_on_disk(tmp_path: Path):
    offsets = {"box": {"distance": 0.5}}
    result = Result("finished", 3, 1.0, [3.0, 2.0, 1.0], 1.0, {}, {"box": {"distance": 0.25}}, offsets)
    assert result._repr_png_().startswith(PNG)
    without = result._repr_html_()
    assert "0.5" in without and "0.25" in without and without.count("<img") == 1
    (tmp_path / "result.png").write_bytes(PNG)
    result.folder = tmp_path
    assert result._repr_html_().count("<img") == 2


def test_bars_appear_where_they_are_wanted(monkeypatch, capsys):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal, for Rich
    calls = []
    for wanted, kind in ((None, None), (False, None), (calls.append, calls.append)):
        with progress.reporting("work", wanted) as report:
            assert report == kind
    with progress.reporting("work", True, lambda report: lambda n: report(n, 4, "half-way")) as report:
        report(2)
    assert "work" in capsys.readouterr().err


NOTEBOOK = '''
import psdr_jit, mitsuba as mi
from psdr_jit.core import progress
progress.PATIENCE = 0.0
mi.set_variant("llvm_ad_rgb")
scene = psdr_jit.scene_io.load_scene(psdr_jit.scene_io.shipped_scene("emissive_card.xml"), res=16)
psdr_jit.gradient(scene, "card.vertex_positions", (1, 0, 0), spp=4, seeds=2)
'''


@pytest.mark.slow
def test_a_notebook_shows_result_and_bar(tmp_path: Path):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(NOTEBOOK)])
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output["data"] for output in book.cells[0].outputs if "data" in output]
    bar = next(data["text/html"] for data in shown if "psdr-bar" in data.get("text/html", ""))
    assert "gradient" in bar and "100%" in bar
    result = next(data for data in shown if "image/png" in data)
    assert "card.vertex_positions" in result["text/html"] and "primary" in result["text/plain"]
    assert io.BytesIO(result["image/png"].encode()).read(6) == b"iVBORw"  # a PNG in base64
