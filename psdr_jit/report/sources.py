"""What a page is made from: an EXR file of `psdr gradient`, or the folder of an optimisation."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.derivative import images
from psdr_jit.derivative.show import unit_of
from psdr_jit.errors import OptionError
from psdr_jit.inverse.journal import VIEWS, rows_of
from psdr_jit.report.model import RADIANCE, SIGNED, Curve, Layer, Report, View

STDERR = "_stderr"
PRIMAL, TOTAL = "primal", "total"
BEFORE_AND_AFTER = ("initial", "final", "target")
SUMS_UP = 1e-4  # of the largest value: rounding of sums in single precision


def read(path: str | os.PathLike) -> Report:
    """The report on a file or a folder. Raises `OptionError` for anything else."""
    path = Path(path)
    if path.is_dir():
        return of_run(path)
    if not path.is_file():
        raise OptionError(f"there is no file or folder '{path}': check the path")
    return of_exr(path)


def of_exr(path: Path) -> Report:
    """Every layer of a file; those that `psdr gradient` writes are known by name."""
    layers, about = _layers(path), images.read_metadata(path)
    errors = {name.removesuffix(STDERR): image for name, image in layers.items() if name.endswith(STDERR)}
    terms = [name for name in about.get("terms", "").split() if name in layers]
    found = []
    for name, image in layers.items():
        if name.endswith(STDERR) and name.removesuffix(STDERR) in layers:
            continue
        error = errors.get(name)
        known = error is not None and bool(np.isfinite(error).any())
        parts = terms if name == TOTAL and _is_sum(image, [layers[term] for term in terms]) else ()
        found.append(Layer(name, _role(name, image, error is not None), image, error if known else None, parts))
    title = f"∂ image / ∂ {about['parameter']}" if "parameter" in about else path.name
    facts = [(key, about[key]) for key in ("integrator", "spp", "seeds") if key in about]
    view = View(path.stem, found, unit_of(about.get("direction", "")))
    return Report(title, about.get("direction", ""), [*facts, ("file", path.name)], [view])


def of_run(folder: Path) -> Report:
    """Images before and after beside their targets, and curves. Raises `OptionError` if it is no folder of a run."""
    rows = rows_of(folder / "log.jsonl")
    views = [_compared(path.stem, _layers(path)) for path in sorted((folder / VIEWS).glob("*.exr"))]
    views = views or _views_of_snapshots(folder / "snapshots")  # of a run that was interrupted
    if not rows and not views:
        raise OptionError(f"'{folder}' is no folder of an optimisation: there is no log.jsonl and no {VIEWS}/*.exr")
    summary = _summary(folder / "result.json")
    names = ", ".join(rows[0]["offset"]) if rows else ""
    facts = [(key, f"{summary[key]:.4g}" if isinstance(summary[key], float) else str(summary[key]))
             for key in ("status", "iterations", "seconds", "loss") if summary.get(key) is not None]  # fmt: skip
    return Report(f"optimisation {folder.resolve().name}", names, facts, views, [row["iteration"] for row in rows],
                  _curves(rows))  # fmt: skip


def _curves(rows: list[dict[str, Any]]) -> list[Curve]:
    """Loss, offsets from the scene file, norms of gradients."""
    if not rows:
        return []
    found = [Curve("loss", "", [row["loss"] for row in rows])]
    for name, kinds in rows[0]["offset"].items():
        for kind in kinds:
            title = f"{name}: {kind.replace('_', ' ')}"
            found.append(Curve(title, "from the scene file,", [row["offset"][name][kind] for row in rows]))
    found += [Curve(name, "", [row["gradient_norm"].get(name) for row in rows], "norm of the gradient")
              for name in rows[0]["gradient_norm"]]  # fmt: skip
    return found


def _views_of_snapshots(folder: Path) -> list[View]:
    """What every view has looked like first and last, beside its target."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for path in sorted(folder.glob("*.exr")):
        for layer, image in _layers(path).items():
            kind, _, name = layer.partition("_")
            if kind == "image":
                seen = found.setdefault(name, {"initial": image})
                seen["final"] = image
            elif kind == "target":
                found.setdefault(name, {})["target"] = image
    return [_compared(name, layers) for name, layers in found.items()]


def _compared(name: str, layers: Mapping[str, np.ndarray]) -> View:
    shown = [Layer(kind, RADIANCE, layers[kind]) for kind in BEFORE_AND_AFTER if kind in layers]
    for kind in ("final", "initial"):
        if kind in layers and "target" in layers:
            shown.append(Layer(f"{kind} − target", SIGNED, None, difference_of=(kind, "target")))
    return View(name, shown, "radiance")


def _layers(path: Path) -> dict[str, np.ndarray]:
    """Images (H, W, C) by layer, in the order in which they are shown; the default layer if there is no other."""
    try:
        channels = images.read_exr(path)
    except (RuntimeError, OSError, ValueError, TypeError) as error:
        raise OptionError(f"'{path}' cannot be read as an OpenEXR file ({error}): give one that psdr gradient has "
                          "written, or the folder of psdr optimize") from error
    grouped: dict[str, dict[str, np.ndarray]] = {}
    for name, plane in channels.items():
        layer, _, channel = name.rpartition(".")
        grouped.setdefault(layer, {})[channel] = plane
    # Channels beside the colours of a layer, as total.dd.T, and those of the default one, as dd.T
    beside = {layer for layer in grouped if layer.rpartition(".")[0] in grouped and "." in layer}
    beside |= {layer.rpartition(".")[2] for layer in beside}
    named = {layer: planes for layer, planes in grouped.items() if layer and layer not in beside}
    named = named or {PRIMAL: grouped.get("", {})}
    found = {layer: _stacked(planes) for layer, planes in named.items() if planes}
    if not found:
        raise OptionError(f"'{path}' has no channels: there is nothing to show")
    first = [PRIMAL, TOTAL, *images.read_metadata(path).get("terms", "").split()]
    names = [name for name in first if name in found] + sorted(set(found) - set(first))
    return {name: found[name] for name in names}


def _stacked(planes: Mapping[str, np.ndarray]) -> np.ndarray:
    """Colour channels in their order, without alpha."""
    names = [name for name in ("R", "G", "B") if name in planes] or [name for name in planes if name != "A"]
    return np.stack([planes[name].astype(np.float64) for name in names or planes], axis=-1)


def _is_sum(image: np.ndarray, parts: list[np.ndarray]) -> bool:
    return bool(parts) and float(np.abs(image - sum(parts)).max()) <= SUMS_UP * float(np.abs(image).max())


def _role(name: str, image: np.ndarray, has_error: bool) -> str:
    """Radiance, unless it is a derivative or has negative values."""
    return RADIANCE if name == PRIMAL or not (has_error or np.nanmin(image, initial=0.0) < 0) else SIGNED


def _summary(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except json.JSONDecodeError as error:
        raise OptionError(f"'{path}' is not JSON ({error}): it was not written by psdr optimize") from error
