"""How the result of a run shows itself in notebooks: its losses, what changed, and the images if they are on disk."""

from __future__ import annotations

from typing import Any

import numpy as np

from psdr_jit.core import markup
from psdr_jit.derivative.images import png_bytes

STRIP = "result.png"  # in the folder of a run


def result_png(result: Any) -> bytes:
    """The losses of a `Result` by iteration."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 2.4), dpi=120, layout="constrained")
    axis = figure.subplots()
    losses = np.array(result.losses, dtype=float)
    axis.plot(result.iterations - len(losses) + np.arange(len(losses)), losses, color="#2166ac", linewidth=1.2)
    if losses.size and np.nanmin(losses) > 0:
        axis.set_yscale("log")
    axis.set_xlabel("iteration")
    axis.set_ylabel("loss")
    axis.spines[["top", "right"]].set_visible(False)
    return png_bytes(figure)


def result_html(result: Any) -> str:
    """Losses, offsets at the start and at the end, and before, after, target if the run has a folder."""
    good = {"finished": True, "diverged": False}.get(result.status)
    about = f"{result.iterations} iterations, {result.seconds:.1f} s · loss {result.loss:.3e} (mean of the last ones)"
    rows = [(name, kind, f"{result.start_offsets[name][kind]:.4g}", f"{value:.4g}")
            for name, now in result.offsets.items() for kind, value in now.items()]  # fmt: skip
    parts = [markup.badge(result.status, good)]
    strip = None if result.folder is None else result.folder / STRIP
    if strip is not None and strip.is_file():
        parts.append(markup.picture(strip.read_bytes(), "initial, final, target, difference"))
    parts.append(markup.picture(result_png(result), "loss by iteration"))
    parts.append(markup.table(("offset from the scene file", "", "at the start", "now"), rows, text=(0, 1)))
    if result.folder is not None:
        parts.append(markup.note(f"log, pictures and values are in {result.folder}"))
    return markup.card("optimisation", about, *parts)
