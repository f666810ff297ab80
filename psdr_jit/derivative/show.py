"""How results of this room show themselves in notebooks: a picture, and the picture above its figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from psdr_jit.core import markup
from psdr_jit.derivative import images

COLUMNS = 4  # panels side by side: more are too small to see edges in


def unit_of(direction: str) -> str:
    """What a derivative image counts, from the words for its direction."""
    return "radiance per radian" if "per radian" in direction else "radiance per unit"


def gradient_png(result: Any) -> bytes:
    """Primal image, derivative, and the terms that are not 0, of a `GradientResult`."""
    panels = [("primal", "primal", result.primal), ("derivative", "derivative", result.total)]
    seen = {name: image for name, image in result.terms.items() if np.any(image)}
    if len(seen) > 1:  # a single one is the derivative itself
        panels += [("derivative", name, image) for name, image in seen.items()]
    rows = -(-len(panels) // COLUMNS)
    panels = [(kind, title, images.colours(image, result.aovs)) for kind, title, image in panels]
    return images.png_bytes(images.panels_figure(panels, unit_of(result.direction), -(-len(panels) // rows)))


def gradient_html(result: Any) -> str:
    """The picture, and the size of every term beside its error."""
    rows = [(name, f"{image.mean():.3e}", f"{_rms(image):.3e}", _known(_rms(stderr)))
            for name, (image, stderr) in result.colours().items()]  # fmt: skip
    plugin, several = result.integrator.get("type", "integrator"), "s" if result.seeds > 1 else ""
    about = f"{result.direction} · {plugin}, {result.seeds} seed{several} × {result.spp} spp, {result.seconds:.1f} s"
    parts = [markup.picture(gradient_png(result), "primal image, derivative and its terms"),
             markup.table(("term", "mean", "rms", "rms standard error"), rows)]  # fmt: skip
    if result.rejected:
        parts.append(markup.note(f"{result.rejected} samples were not finite and were dropped"))
    return markup.card(f"∂ image / ∂ {result.param}", about, *parts)


def check_png(result: Any) -> bytes:
    """Estimate, finite differences and what is between them, of a `CheckResult`."""
    panels = [("derivative", "estimate", result.estimate), ("derivative", "finite differences", result.reference),
              ("derivative", "estimate − finite differences", result.estimate - result.reference)]  # fmt: skip
    panels = [(kind, title, images.colours(image, result.aovs)) for kind, title, image in panels]
    return images.png_bytes(images.panels_figure(panels, unit_of(result.direction)))


def check_html(result: Any) -> str:
    """The verdict, what it rests on, and the images."""
    v = result.verdict
    good = {"pass": True, "fail": False}.get(v.verdict)
    rows = [("gain", f"{v.gain:.4f} ± {v.gain_stderr:.4f}", "1 is right"),
            ("rms z", f"{v.rms_z:.3f}", f"of {v.blocks} blocks of {result.block} px; honest errors give 1"),
            ("largest |z|", f"{v.max_z:.2f}", "standard errors"),
            ("estimate", f"{result.seeds} × {result.spp}", f"seeds × spp; terms: {', '.join(result.terms)}"),
            ("finite differences", f"{result.reference_seeds} × 2 × {result.reference_spp}",
             f"seeds × sides × spp, eps {result.eps:.3g}")]  # fmt: skip
    about = f"{result.direction} · {result.seconds:.1f} s"
    return markup.card(
        f"check of ∂ image / ∂ {result.param}", about, markup.badge(v.verdict.upper(), good), v.reason,
        markup.picture(check_png(result), "estimate, finite differences, difference"),
        markup.table((), rows, text=(0, 2)),
    )  # fmt: skip


def _rms(image: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(image))))


def _known(error: float) -> str:
    return f"{error:.1e}" if np.isfinite(error) else "–"
