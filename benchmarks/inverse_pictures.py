"""Pictures of recovered shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.derivative.images import save_figure

PRISM = "prism.vertex_positions"
CORNERS = 100  # of the cross-section; the mesh begins with their lower ends


def write_section(path: Path, problem: Any, before: Any, after: Any) -> Path:
    """The cross-section at the start, at the end and in truth, and the displacement of each of its corners."""
    from matplotlib.figure import Figure

    variable = problem.variables[PRISM]
    figure = Figure(figsize=(8.4, 3.4), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.5))
    for latents, style in ((problem.own, {"color": "0.75", "linewidth": 4, "label": "truth"}),
                           (before, {"color": "black", "linestyle": ":", "linewidth": 1, "label": "start"}),
                           (after, {"color": "black", "linewidth": 1, "label": "found"})):  # fmt: skip
        p = np.array(variable.value(latents[PRISM])).reshape(-1, 3)[:CORNERS]
        ring = np.concatenate([p, p[:1]])
        left.plot(ring[:, 0], -ring[:, 2], **style)
        start = np.array(variable.value(before[PRISM])).reshape(-1, 3)[:CORNERS]
        radius, first = (np.linalg.norm(q[:, [0, 2]] - _middle(start), axis=1) for q in (p, start))
        if latents is not before:
            right.plot(np.arange(CORNERS), radius - first, **style)
    left.set_aspect("equal")
    left.legend(fontsize=8, frameon=False, loc="center")
    left.set_xlabel("x")
    left.set_ylabel("-z")
    right.set_xlabel("corner")
    right.set_ylabel("displacement from the start [scene units]")
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
    return save_figure(path, figure)


def _middle(ring: np.ndarray) -> np.ndarray:
    """Middle of a cross-section in x and z."""
    across = ring[:, [0, 2]]
    return (across.max(0) + across.min(0)) / 2
