"""Pictures of a run: images before and after beside their targets, and curves over the iterations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.derivative.images import COLOUR_MAP, grey, robust_limit, save_figure, srgb

WIDTH = 2.6  # of a panel [inches]


def write_strip(path: Path, rows: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]]) -> Path:
    """One row per view: initial, final, target, and the signed error of the final image on one scale for all.

    `rows`: (name, initial, final, target), images (H, W, C).
    """
    from matplotlib.figure import Figure

    limit = robust_limit([grey(final) - grey(target) for _, _, final, target in rows])
    before = robust_limit([grey(initial) - grey(target) for _, initial, _, target in rows])
    limit = max(limit, before / 20)  # noise alone does not fill the scale
    figure = Figure(figsize=(4 * WIDTH + 0.8, sum(WIDTH * r[1].shape[0] / r[1].shape[1] for r in rows) + 0.4), dpi=120,
                    layout="constrained")  # fmt: skip
    axes = figure.subplots(len(rows), 4, squeeze=False)
    for row, (name, *shown) in zip(axes, rows, strict=True):
        initial, final, target = shown
        for axis, image in zip(row, (initial, final, target), strict=False):
            axis.imshow(srgb(image), interpolation="nearest")
        error = row[3].imshow(
            grey(final) - grey(target), cmap=COLOUR_MAP, vmin=-limit, vmax=limit, interpolation="nearest"
        )
        row[0].set_ylabel(name, fontsize=8)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, title in zip(axes[0], ("initial", "final", "target", "final − target"), strict=True):
        axis.set_title(title, fontsize=9)
    figure.colorbar(error, ax=axes[:, 3], shrink=0.8, label="radiance")
    return save_figure(path, figure)


def write_curves(path: Path, rows: Sequence[dict[str, Any]]) -> Path:
    """Loss, and how far every variable is from the scene's own value, against iterations."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    iterations = [row["iteration"] for row in rows]
    finite = [row["loss"] for row in rows if row["loss"] is not None]
    losses = np.array([row["loss"] for row in rows], dtype=float)
    left.plot(iterations, losses, color="black", linewidth=1)
    left.set_ylabel("loss")
    if finite and min(finite) > 0:
        left.set_yscale("log")
    styles = ("-", "--", ":", "-.")
    names = [(name, kind) for name in rows[0]["offset"] for kind in rows[0]["offset"][name]] if rows else []
    for k, (name, kind) in enumerate(names):
        values = np.array([row["offset"][name][kind] for row in rows])
        scale = float(values.max()) or 1.0
        right.plot(iterations, np.maximum(values / scale, 1e-6), styles[k % len(styles)], color=str(0.6 * (k // 4) / 3),
                   linewidth=1, label=f"{name}: {kind}, at most {scale:.3g}")  # fmt: skip
    right.set_yscale("log")
    right.set_ylabel("offset from the scene file")
    for axis in (left, right):
        axis.set_xlabel("iteration")
        axis.spines[["top", "right"]].set_visible(False)
    if names:
        right.legend(fontsize=7, frameon=False)
    return save_figure(path, figure)
