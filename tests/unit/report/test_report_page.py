"""Pages: nothing in them leads elsewhere, they keep to their size, and what cannot be shown is refused by name."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from psdr_jit.cli.main import main
from psdr_jit.derivative import images
from psdr_jit.errors import OptionError
from psdr_jit.report import page, sources
from psdr_jit.report.encode import FLOOR, LADDER, Stream
from psdr_jit.report.model import RADIANCE, SIGNED, Layer, Report, View


def noise(seed: int, size: int = 24) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(size, size + 3, 3)) * 10 ** rng.uniform(-4, 1, size=(size, size + 3, 1))


def written(folder, **metadata: str):
    terms = {"interior": noise(1), "primary": np.where(noise(2) > 0.1, noise(3), 0)}
    layers = {"primal": abs(noise(4)), "total": sum(terms.values()), "total_stderr": abs(noise(5)),
              **terms, "interior_stderr": abs(noise(6)), "primary_stderr": abs(noise(7))}  # fmt: skip
    about = {"parameter": "a</script><b>.to_world", "terms": "interior primary", "direction": "about z, per radian",
             **metadata}  # fmt: skip
    return images.write_exr(folder / "a.exr", layers, about)


def data_of(html: str) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1])


@pytest.mark.parametrize("precision", LADDER)
def test_values_are_as_precise_as_is_said(precision):
    image = noise(0)
    stream = Stream(precision)
    how, stored = stream.value(image, precision.value)
    floor = FLOOR * images.robust_limit([image])
    # half a step, of the value or of the floor; d sinh(u) = cosh(u) du, the rest is second order
    allowed = precision.value / 2 * np.hypot(image, floor) * (1 + precision.value)
    assert np.all(abs(stored - image) <= allowed)
    assert how["channels"] == 3 and len(stream.bytes()) < image.size * 4


def test_coarser_is_smaller_and_noise_keeps_to_the_limit():
    image = noise(0, 64)
    report = Report("noise", "", [], [View("v", [Layer("total", SIGNED, image, abs(image))], "unit")])
    sizes = [len(page.html_of(report, limit)) for limit in (9.0, 0.08, 0.07)]
    assert sizes[0] > sizes[1] > sizes[2]
    assert sizes[1] <= 0.08e6 and sizes[2] <= 0.07e6


def test_a_page_is_one_file(tmp_path):
    html = page.html_of(sources.read(written(tmp_path)))
    assert not re.search(r"""(src|href)\s*=|url\(|@import|fetch\(|XMLHttpRequest""", html)
    assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", html)
    assert "default-src 'none'" in html
    assert html.count("</script>") == 3, "a name of a parameter must not end a script"
    assert "$" + "data" not in html and "a&lt;/script&gt;" in html


def test_layers_of_a_gradient(tmp_path):
    data = data_of(page.html_of(sources.read(written(tmp_path, spp="16", seeds="4"))))
    (view,) = data["views"]
    assert view["layers"] == ["primal", "total", "interior", "primary"]
    assert view["unit"] == "radiance per radian" and (view["width"], view["height"]) == (27, 24)
    encoded = {layer["name"]: layer for layer in view["encoded"]}
    assert list(encoded)[-1] == "total" and encoded["total"]["value"]["of"] == ["interior", "primary"]
    assert {name: layer["role"] for name, layer in encoded.items()} == {
        "primal": RADIANCE, "interior": SIGNED, "primary": SIGNED, "total": SIGNED}  # fmt: skip
    assert encoded["primal"]["stderr"] is None and encoded["primary"]["stderr"] is not None
    assert ["spp", "16"] in data["facts"]


def test_one_seed_has_no_errors(tmp_path):
    nan = np.full((4, 4, 3), np.nan)
    path = images.write_exr(tmp_path / "a.exr", {"total": np.ones((4, 4, 3)), "total_stderr": nan}, {"terms": "total"})
    (layer,) = sources.read(path).views[0].layers
    assert layer.stderr is None


def test_values_that_are_not_finite_have_a_number_of_their_own():
    image = noise(0)
    image[3, 4] = np.nan, np.inf, -np.inf
    how, _ = Stream(LADDER[2]).value(image, LADDER[2].value)
    assert how["nan"] is not None
    assert Stream(LADDER[2]).value(noise(0), LADDER[2].value)[0]["nan"] is None


def test_runs_have_curves_and_differences(tmp_path):
    rows = [{"iteration": k, "loss": 1.0 / (k + 1) if k else None, "gradient_norm": {"box (shift)": 0.5},
             "offset": {"box": {"angle_degrees": 3.0 - k}}} for k in range(3)]  # fmt: skip
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, rows)) + '\n{"iter', encoding="utf-8")
    (tmp_path / "views").mkdir()
    image = abs(noise(0))
    images.write_exr(tmp_path / "views" / "camera.exr", {"initial": image, "final": image, "target": image})
    data = data_of(page.html_of(sources.read(tmp_path)))
    assert data["iterations"] == [0, 1, 2]
    assert {c["name"]: c["values"] for c in data["curves"]} == {
        "loss": [None, 0.5, 0.333333], "box: angle degrees": [3, 2, 1], "box (shift)": [0.5] * 3}  # fmt: skip
    assert data["views"][0]["layers"] == ["initial", "final", "target", "final − target", "initial − target"]


def test_an_interrupted_run_shows_its_snapshots(tmp_path):
    (tmp_path / "snapshots").mkdir()
    for k in range(3):
        layers = {"image_left_eye": noise(k), "target_left_eye": noise(9)}
        images.write_exr(tmp_path / "snapshots" / f"{k:06d}.exr", layers)
    (view,) = sources.read(tmp_path).views
    found = {layer.name: layer.image for layer in view.layers}
    assert view.name == "left_eye" and list(found)[:3] == ["initial", "final", "target"]
    for name, k in (("initial", 0), ("final", 2), ("target", 9)):
        assert np.allclose(found[name], noise(k), rtol=1e-6)


def test_aovs_are_no_layers(tmp_path):
    layers = {name: np.ones((4, 4, 4)) for name in ("primal", "total")}
    (view,) = sources.read(images.write_exr(tmp_path / "a.exr", layers, {"terms": "total"}, aovs=["dd.T"])).views
    assert [(layer.name, layer.image.shape[-1]) for layer in view.layers] == [("primal", 3), ("total", 3)]


def test_what_is_no_result_is_refused(tmp_path, capsys):
    (tmp_path / "a.exr").write_bytes(b"no image")
    for path, words in ((tmp_path, "log.jsonl"), (tmp_path / "b.exr", "no file"), (tmp_path / "a.exr", "OpenEXR")):
        with pytest.raises(OptionError, match=words):
            sources.read(path)
    assert main(["report", str(tmp_path / "b.exr")]) == 2
    assert "b.exr" in capsys.readouterr().err
    assert main(["report", str(written(tmp_path)), "--megabytes", "0"]) == 2


def test_command_writes_beside_its_input(tmp_path, capsys):
    assert main(["report", str(written(tmp_path))]) == 0
    assert (tmp_path / "a.html").is_file() and "a.html" in capsys.readouterr().out
