"""Derivative images by forward mode: total, each term alone, and the standard error of every pixel."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from psdr_jit.cluster.engine import Engine
from psdr_jit.cluster.source import SceneFile
from psdr_jit.core.progress import reporting
from psdr_jit.core.threads import one_at_a_time
from psdr_jit.derivative import show
from psdr_jit.derivative.images import colours
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.remote import RemoteTerms
from psdr_jit.derivative.sampler import PRIMAL, TOTAL, DerivativeSampler, Terms
from psdr_jit.derivative.statistics import GroupedImages
from psdr_jit.errors import OptionError
from psdr_jit.options import require_count
from psdr_jit.paths.aovs import Aovs
from psdr_jit.scene.io import find_sensor

__all__ = ["DerivativeSampler", "GradientResult", "gradient"]  # the first has its place in `sampler`

MAX_GROUPS = 64     # images kept for the standard errors; more seeds share a group


@dataclass(frozen=True, repr=False)
class GradientResult:
    """Images are float64 arrays (H, W, C) in radiance per unit of the direction (radians for rotations)."""

    primal: np.ndarray
    total: np.ndarray
    total_stderr: np.ndarray              # per pixel, NaN for a single seed
    terms: dict[str, np.ndarray]          # empty when the integrator's terms cannot be separated
    term_stderr: dict[str, np.ndarray]
    rejected: int | None                  # non-finite samples dropped; None when not counted
    spp: int                              # per seed and term
    seeds: int
    seconds: float
    param: str
    direction: str
    integrator: dict[str, Any] = field(default_factory=dict)

    def layers(self) -> dict[str, np.ndarray]:
        """Everything by layer name, primal first: what `images.write_exr` takes."""
        named = {"primal": self.primal, "total": self.total, "total_stderr": self.total_stderr}
        for term, image in self.terms.items():
            named[term] = image
            named[f"{term}_stderr"] = self.term_stderr[term]
        return named

    @property
    def aovs(self) -> list[str]:
        """Names of the last channels, those that are no colours."""
        return Aovs.parse(self.integrator.get("aovs", "")).channels

    def colours(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Total and terms by name, with their standard errors, of colours: `aovs` have other units."""
        found = {"total": (self.total, self.total_stderr)}
        found |= {name: (image, self.term_stderr[name]) for name, image in self.terms.items()}
        return {name: tuple(colours(image, self.aovs) for image in pair) for name, pair in found.items()}

    def __repr__(self) -> str:
        """One line a term instead of the arrays, of colours alone."""
        plugin, count = self.integrator.get("type", "integrator"), f"{self.seeds} seed{'s' if self.seeds > 1 else ''}"
        lines = [f"d image / d {self.param}, {self.direction}",
                 f"  {plugin}, {count} x {self.spp} spp, {self.seconds:.1f} s",
                 *(_line(name, *pair) for name, pair in self.colours().items())]
        if self.aovs:
            lines.append(f"  of colours; {', '.join(self.aovs)} are in the images as well")
        if self.seeds < 2:
            lines.append("  no standard errors: they come from the scatter of two seeds or more")
        if self.rejected:
            lines.append(f"  {self.rejected} samples were not finite and were dropped")
        return "\n".join(lines)

    def _repr_png_(self) -> bytes:
        return show.gradient_png(self)

    def _repr_html_(self) -> str:
        return show.gradient_html(self)

    def metadata(self) -> dict[str, str]:
        """What was computed, as strings for an image header."""
        options = " ".join(f"{k}={v}" for k, v in self.integrator.items())
        return {"parameter": self.param, "direction": self.direction, "integrator": options,
                "spp": str(self.spp), "seeds": str(self.seeds), "terms": " ".join(self.terms) or "total only"}


def _line(name: str, image: np.ndarray, stderr: np.ndarray) -> str:
    """Mean and size of an image [radiance per unit], and of its error where that is known."""
    error = np.sqrt((stderr**2).mean())
    known = f"   rms standard error {error:.1e}" if np.isfinite(error) else ""
    return f"  {name:9s} mean {image.mean(): .4e}   rms {np.sqrt((image**2).mean()):.4e}{known}"


@one_at_a_time
def gradient(scene: Any, param: str | Perturbation, direction: Any = None, *, rotate: Any = None,
             index: int | None = None, integrator: Any = None, spp: int = 64, seeds: int = 8, sensor: int = 0,
             progress: Callable[[int, int], None] | bool | None = None, client: Any = None,
             source: SceneFile | str | None = None) -> GradientResult:
    """d(image)/d(theta) for `param` moved along a direction, in forward mode.

    `param`, `direction`, `rotate`, `index` as in `perturb`. `integrator`: an instantiated integrator (total
    only), a dict of its properties, a plugin name, or None for `psdr_path` with the path lengths of the
    scene's own integrator. With properties or a name, each term is rendered alone and the total is their sum.

    Every one of the `seeds` is an independent image with `spp` samples per pixel and term; the standard
    errors come from their scatter. The scene is left as it was found.
    `progress(done, total)` is called after every seed; True shows a bar, None does so in notebooks.
    `client`: a `distributed.Client`, whose workers then render; `source`: the file that the scene was loaded from. The
    numbers are the same for any number of workers, and with none.
    """
    require_count("spp", spp)
    require_count("seeds", seeds)
    if spp <= 0 or seeds <= 0:
        raise OptionError(f"spp and seeds must be positive, got spp={spp}, seeds={seeds}")
    if not isinstance(param, Perturbation):
        param = perturb(scene, param, direction, rotate=rotate, index=index)
    find_sensor(scene, sensor)
    start = time.perf_counter()
    given = Terms if client is None else partial(RemoteTerms, Engine(client, scene, source))
    terms = given(param, integrator, sensor, spp)
    groups = min(seeds, MAX_GROUPS)
    primal, total = GroupedImages(1), GroupedImages(groups)
    each = {name: GroupedImages(groups) for name in terms.names}
    with reporting("gradient", progress) as report:
        for seed, images in enumerate(terms.images(seeds)):
            primal.add(images.pop(PRIMAL))
            for name, image in images.items():
                each[name].add(image)
            total.add(sum(images.values()))
            if report is not None:
                report(seed + 1, seeds)
    lost = _report_not_finite(terms.not_finite)
    each.pop(TOTAL, None)
    return GradientResult(
        primal=primal.mean(), total=total.mean(), total_stderr=total.stderr(),
        terms={name: images.mean() for name, images in each.items()},
        term_stderr={name: images.stderr() for name, images in each.items()},
        rejected=None if terms.rejected is None else terms.rejected + lost, spp=spp, seeds=seeds,
        seconds=time.perf_counter() - start, param=param.name, direction=param.label, integrator=terms.spec)


def _report_not_finite(lost: dict[str, int]) -> int:
    if lost:
        warnings.warn(f"derivative pixels that were not finite counted as 0: {lost}", RuntimeWarning,
                      stacklevel=3)
    return sum(lost.values())
