"""A `Report` as one HTML file: template, style, scripts and data, all inside."""

from __future__ import annotations

import json
from base64 import b64encode
from dataclasses import replace
from html import escape
from importlib import resources
from string import Template
from typing import Any

import numpy as np

from psdr_jit.report.encode import LADDER, Precision, Stream
from psdr_jit.report.model import SIGNED, Layer, Report, View

SCRIPTS = ("decode.js", "colours.js", "panes.js", "readout.js", "curves.js", "main.js")
LIMIT_MB = 5.0
BANDS, ROWS = 8, 8  # so many bands of so many rows, on which a precision is tried before all of an image is encoded


def html_of(report: Report, limit_mb: float = LIMIT_MB) -> str:
    """The page, with values as precise as its size allows."""
    for precision in LADDER[_first_rung(report, limit_mb) : -1]:
        page = _page(report, precision, *_encoded(report, precision))
        if len(page.encode()) <= limit_mb * 1e6:
            return page
    return _page(report, LADDER[-1], *_encoded(report, LADDER[-1]))


def _first_rung(report: Report, limit_mb: float) -> int:
    """The finest precision that may fit, by a few rows of every image."""
    bands = replace(report, views=[_sampled(view) for view in report.views])
    rows, tried = (sum(len(view.layers[0].image) for view in found.views) for found in (report, bands))
    room = limit_mb * 1e6 - len(_page(report, LADDER[0], [], "").encode())
    for k, precision in enumerate(LADDER[:-1]):
        _, numbers = _encoded(bands, precision)
        if len(numbers) * rows / max(1, tried) <= room:
            return max(0, k - 1)  # the estimate is rough, and too coarse would be for good
    return len(LADDER) - 1


def _sampled(view: View) -> View:
    """Some rows of all layers, in bands all over the image."""

    def cut(image: np.ndarray | None) -> np.ndarray | None:
        if image is None or len(image) <= BANDS * ROWS:
            return image
        starts = np.linspace(0, len(image) - ROWS, BANDS).astype(int)
        return np.concatenate([image[start : start + ROWS] for start in starts])

    return replace(view, layers=[replace(x, image=cut(x.image), stderr=cut(x.stderr)) for x in view.layers])


def _encoded(report: Report, precision: Precision) -> tuple[list[dict[str, Any]], str]:
    """How to decode all images, and their numbers in base64."""
    stream = Stream(precision)
    views = [_view(view, stream) for view in report.views]
    return views, b64encode(stream.bytes()).decode()


def _page(report: Report, precision: Precision, views: list[dict[str, Any]], numbers: str) -> str:
    curves = [{"name": c.name, "unit": c.unit, "group": c.group, "values": [_short(v) for v in c.values]}
              for c in report.curves]  # fmt: skip
    data = {"title": report.title, "about": report.about, "facts": [list(fact) for fact in report.facts],
            "precision": precision.value / 2, "views": views, "iterations": list(report.iterations),
            "curves": curves}  # fmt: skip
    # "<" would end the element that holds the data
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    folder = resources.files("psdr_jit.report") / "page"
    parts = {"title": escape(report.title), "style": (folder / "page.css").read_text(encoding="utf-8"),
             "script": "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS),
             "data": text, "numbers": numbers}  # fmt: skip
    return Template((folder / "page.html").read_text(encoding="utf-8")).substitute(parts)


def _view(view: View, stream: Stream) -> dict[str, Any]:
    """Layers in an order in which a sum comes after its parts: that of decoding."""
    height, width = next(np.shape(layer.image)[:2] for layer in view.layers if layer.image is not None)
    order = sorted(view.layers, key=lambda layer: (bool(layer.difference_of), bool(layer.sum_of)))
    stored: dict[str, np.ndarray] = {}
    encoded = {layer.name: _layer(layer, stream, stored) for layer in order}
    return {"name": view.name, "unit": view.unit, "width": width, "height": height,
            "layers": [layer.name for layer in view.layers], "encoded": list(encoded.values())}  # fmt: skip


def _layer(layer: Layer, stream: Stream, stored: dict[str, np.ndarray]) -> dict[str, Any]:
    found: dict[str, Any] = {"name": layer.name, "role": layer.role, "value": None, "stderr": None}
    if layer.difference_of:
        return {**found, "role": SIGNED, "difference": list(layer.difference_of)}
    image = np.asarray(layer.image, dtype=np.float64)
    if layer.sum_of:
        found["value"] = stream.residual(image, sum(stored[name] for name in layer.sum_of), layer.sum_of)
    else:
        found["value"], stored[layer.name] = stream.value(image, stream.precision.value)
    if layer.stderr is not None:
        found["stderr"], _ = stream.value(np.asarray(layer.stderr, dtype=np.float64), stream.precision.stderr)
    return found


def _short(value: float | None) -> float | None:
    """Six digits are more than a curve shows."""
    return None if value is None else float(f"{value:.6g}")
