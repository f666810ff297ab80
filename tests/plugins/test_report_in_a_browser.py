"""Pages in a real browser: what is under the pointer is what the file holds, and every control changes what it says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, browser

from psdr_jit.cli.main import main
from psdr_jit.derivative import images
from psdr_jit.scene import io as scene_io

pytestmark = pytest.mark.slow

MOVE = ["--wrt", "card.vertex_positions", "--direction", "1,0,0", "--spp", "8", "--seeds", "4", "--quiet"]
CELLS = """return [...document.querySelectorAll("#readout td[data-layer]")].map((cell) =>
    [cell.dataset.layer, cell.dataset.channel, Number(cell.dataset.value), cell.dataset.stderr === undefined ? null
     : Number(cell.dataset.stderr)])"""
PAINTED = "return document.querySelector(arguments[0]).toDataURL()"
DIGITS = 5e-4  # relative: what values are compared to, of the value or of a hundredth of the largest


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture(scope="module")
def gradient(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("gradient") / "card.exr"
    card = str(scene_io.shipped_scene("emissive_card.xml"))
    assert main(["gradient", card, *MOVE, "-o", str(path)]) == 0
    assert main(["report", str(path), "--quiet"]) == 0
    return path


def shown(window: Browser) -> dict[tuple[str, str], tuple[float, float | None]]:
    return {(layer, channel): (value, error) for layer, channel, value, error in window.run(CELLS)}


def pixel_of(window: Browser) -> tuple[int, int]:
    return tuple(map(int, re.findall(r"\d+", window.run("return document.getElementById('pixel').textContent"))))


def close(found: float, right: np.ndarray, at: tuple[int, int], tolerance: float = DIGITS) -> bool:
    return abs(found - right[at]) <= tolerance * max(abs(right[at]), 1e-2 * float(np.abs(right).max()))


def test_values_under_the_pointer_are_those_of_the_file(window, gradient):
    channels = images.read_exr(gradient)
    window.open(gradient.with_suffix(".html"))
    seen = set()
    for x, y in ((-40, 10), (60, -120), (0, 0), (110, 35)):
        window.point("#signed canvas", x, y)
        column, line = pixel_of(window)
        at = (line, column)
        seen.add(at)
        found = shown(window)
        assert {layer for layer, _ in found} >= {"primal", "total", "interior", "primary"}
        for (layer, channel), (value, error) in found.items():
            planes = [channels[f"{layer}.{c}"] for c in "RGB"]
            right = planes[int(channel)] if channel != "mean" else np.mean(planes, axis=0)
            assert close(value, right, at), (layer, channel, at)
            if error is not None and channel != "mean":
                assert close(error, channels[f"{layer}_stderr.{'RGB'[int(channel)]}"], at, 2e-2), (layer, channel, at)
    assert len(seen) == 4


def test_the_pointer_is_where_it_seems(window, gradient):
    """A pixel's place on the film, from the size of the pane; in the middle of the picture also when zoomed."""
    height, width = images.read_exr(gradient)["R"].shape
    window.open(gradient.with_suffix(".html"))
    wide = window.run("return document.querySelector('#signed canvas').clientWidth")
    pixel = wide / width
    window.point("#signed canvas", 8.5 * pixel, (2.5 - height / 2) * pixel)
    assert pixel_of(window) == (width // 2 + 8, 2)
    window.run("""const canvas = document.querySelector('#signed canvas');
        const middle = canvas.getBoundingClientRect().left + arguments[0];
        canvas.dispatchEvent(new WheelEvent('wheel', {deltaY: -300, clientX: middle}))""", wide / 2)
    # twice as large, about the middle of the row above the film
    window.point("#signed canvas", 9 * pixel, -wide / 2 + pixel)
    assert pixel_of(window) == (width // 2 + 4, 0)


def test_layers_switch(window, gradient):
    window.open(gradient.with_suffix(".html"))
    pictures = {}
    for layer in ("total", "interior", "primary"):
        window.click(f"#layers button[data-key='{layer}']")
        assert window.run("return document.querySelector('#layers [aria-selected=true]').textContent") == layer
        pictures[layer] = window.run(PAINTED, "#signed > canvas")
    assert pictures["primary"] != pictures["interior"]
    assert pictures["primary"] == pictures["total"], "the interior term of an emitter that moves is 0"
    window.click("#show button[data-key='error']")
    errors = window.run(PAINTED, "#signed > canvas")
    assert errors != pictures["primary"]
    window.click("#channel button[data-key='0']")
    window.click("#theme")
    assert window.run(PAINTED, "#signed > canvas") != errors


def test_the_scale_names_its_ends_and_unit(window, gradient):
    window.open(gradient.with_suffix(".html"), layer="primary", theme="light")
    text = window.run("return [...document.querySelectorAll('#ticks span')].map((mark) => mark.textContent)")
    numbers = [float(mark.replace("−", "-")) for mark in text]
    assert len(numbers) >= 3 and numbers == sorted(numbers) and numbers[0] == -numbers[-1]
    limit = images.robust_limit([images.grey(np.stack([images.read_exr(gradient)[f"{n}.{c}"] for c in "RGB"], -1))
                                 for n in ("total", "primary")])  # fmt: skip
    assert 0.5 * limit < numbers[-1] <= limit * 1.02
    assert window.run("return document.getElementById('unit').textContent") == "radiance per unit"


def test_nothing_is_asked_of_the_network(window, gradient):
    window.open(gradient.with_suffix(".html"))
    assert window.run("return performance.getEntriesByType('resource').length") == 0


def test_a_run_shows_before_after_and_curves(window, tmp_path):
    before = np.zeros((16, 16, 3))
    after = np.ones((16, 16, 3))
    (tmp_path / "views").mkdir()
    images.write_exr(tmp_path / "views" / "a.exr", {"initial": before, "final": after, "target": after * 0.5})
    rows = [{"iteration": k, "loss": 9 - k, "gradient_norm": {"b": 1}, "offset": {"b": {"rms": k}}} for k in range(5)]
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n", encoding="utf-8")
    assert main(["report", str(tmp_path), "--quiet"]) == 0
    window.open(tmp_path / "report.html", split="0.25")
    bright = """const canvas = document.querySelector('#radiance canvas'), at = canvas.getContext('2d');
        return [0.1, 0.4, 0.9].map((x) => at.getImageData(x * canvas.width, 5, 1, 1).data[0])"""
    assert window.run(bright) == [0, 255, 255]
    window.run("const s = document.getElementById('split'); s.value = 700; s.dispatchEvent(new Event('input'))")
    assert window.run(bright) == [0, 0, 255]
    found = shown(window)
    assert found["final − target", "mean"][0] == pytest.approx(0.5, rel=1e-3)
    assert found["initial − target", "0"][0] == pytest.approx(-0.5, rel=1e-3)
    charts = window.run("return [...document.querySelectorAll('#curves h2')].map((title) => title.textContent)")
    assert charts == ["loss", "b: rms", "norm of the gradient"]
    window.point("#curves svg", 0, 0)
    assert "iteration 2: 7" in window.run("return document.querySelector('#curves .bar span').textContent")
