"""Derivative images by forward mode: total, each term alone, and the standard error of every pixel."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import require_samples
from psdr_jit.core.progress import reporting
from psdr_jit.core.threads import one_at_a_time
from psdr_jit.derivative import integrator_specs, show
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import GroupedImages
from psdr_jit.errors import OptionError
from psdr_jit.options import require_count
from psdr_jit.scene.io import find_sensor

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

    def __repr__(self) -> str:
        """One line a term instead of the arrays."""
        plugin, count = self.integrator.get("type", "integrator"), f"{self.seeds} seed{'s' if self.seeds > 1 else ''}"
        lines = [f"d image / d {self.param}, {self.direction}",
                 f"  {plugin}, {count} x {self.spp} spp, {self.seconds:.1f} s",
                 _line("total", self.total, self.total_stderr)]
        lines += [_line(name, image, self.term_stderr[name]) for name, image in self.terms.items()]
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


class DerivativeSampler:
    """Adds independent seeds to a derivative image, as many as one asks for."""

    def __init__(self, perturbation: Perturbation, integrator: Any, sensor: Any = 0, spp: int = 64,
                 groups: int = 32, first_seed: int = 0) -> None:
        self.perturbation = perturbation
        self.integrator = integrator
        self.sensor = find_sensor(perturbation.scene, sensor)
        require_samples(self.sensor, spp)
        self.spp = spp
        self.images = GroupedImages(groups)
        self.not_finite = 0     # pixel values that arrived as NaN or inf
        self.seconds = 0.0
        self._next_seed = first_seed

    @property
    def seeds(self) -> int:
        return self.images.total

    def render(self, seed: int) -> np.ndarray:
        """The derivative image (H, W, C) of one seed; non-finite values become 0 and are counted."""
        # attached anew for each seed: rendering uses the tangents in the scene up
        self.perturbation.attach()
        image = self.integrator.render_forward(self.perturbation.scene, self.perturbation.params,
                                               sensor=self.sensor, seed=seed, spp=self.spp)
        image = integrator_specs.to_image(dr.detach(image))
        bad = ~np.isfinite(image)
        self.not_finite += int(bad.sum())
        return np.where(bad, 0.0, image)

    def add(self, seeds: int) -> None:
        start = time.perf_counter()
        for _ in range(seeds):
            self.images.add(self.render(self._next_seed))
            self._next_seed += 1
        self.perturbation.restore()
        self.seconds += time.perf_counter() - start


@one_at_a_time
def gradient(scene: Any, param: str | Perturbation, direction: Any = None, *, rotate: Any = None,
             index: int | None = None, integrator: Any = None, spp: int = 64, seeds: int = 8, sensor: int = 0,
             progress: Callable[[int, int], None] | bool | None = None) -> GradientResult:
    """d(image)/d(theta) for `param` moved along a direction, in forward mode.

    `param`, `direction`, `rotate`, `index` as in `perturb`. `integrator`: an instantiated integrator (total
    only), a dict of its properties, a plugin name, or None for `psdr_path` with the path lengths of the
    scene's own integrator. With properties or a name, each term is rendered alone and the total is their sum.

    Every one of the `seeds` is an independent image with `spp` samples per pixel and term; the standard
    errors come from their scatter. The scene is left as it was found.
    `progress(done, total)` is called after every seed; True shows a bar, None does so in notebooks.
    """
    require_count("spp", spp)
    require_count("seeds", seeds)
    if spp <= 0 or seeds <= 0:
        raise OptionError(f"spp and seeds must be positive, got spp={spp}, seeds={seeds}")
    if not isinstance(param, Perturbation):
        param = perturb(scene, param, direction, rotate=rotate, index=index)
    view = find_sensor(scene, sensor)
    start = time.perf_counter()
    samplers, primal_integrator, spec = _samplers(scene, param, integrator, sensor, spp,
                                                 min(seeds, MAX_GROUPS))
    total, primal = GroupedImages(min(seeds, MAX_GROUPS)), GroupedImages(1)
    try:
        with reporting("gradient", progress) as report:
            for seed in range(seeds):
                with dr.suspend_grad():
                    image = primal_integrator.render(scene, view, seed=seed, spp=spp)
                primal.add(integrator_specs.to_image(image))
                images = [s.render(seed) for s in samplers.values()]
                for s, image in zip(samplers.values(), images, strict=True):
                    s.images.add(image)
                total.add(sum(images))
                if report is not None:
                    report(seed + 1, seeds)
    finally:
        param.restore()
    lost = _report_not_finite(samplers)
    counts = [integrator_specs.rejected(s.integrator) for s in samplers.values()]
    terms = {k: s for k, s in samplers.items() if k != "total"}
    return GradientResult(
        primal=primal.mean(), total=total.mean(), total_stderr=total.stderr(),
        terms={k: s.images.mean() for k, s in terms.items()},
        term_stderr={k: s.images.stderr() for k, s in terms.items()},
        rejected=None if None in counts else sum(counts) + lost, spp=spp, seeds=seeds,
        seconds=time.perf_counter() - start, param=param.name, direction=param.label, integrator=spec)


def _samplers(scene: Any, param: Perturbation, integrator: Any, sensor: int, spp: int,
              groups: int) -> tuple[dict[str, DerivativeSampler], Any, dict[str, Any]]:
    """One sampler for each term (or one named 'total'), the integrator of the primal image, and the spec."""
    if hasattr(integrator, "render_forward"):
        spec = {"type": str(integrator).split("[")[0], **integrator_specs.path_options(integrator)}
        return {"total": DerivativeSampler(param, integrator, sensor, spp, groups)}, integrator, spec
    spec = integrator_specs.integrator_spec(scene, integrator)
    whole = differentiable(spec)
    terms = integrator_specs.terms_of(spec)
    if not terms:
        return {"total": DerivativeSampler(param, whole, sensor, spp, groups)}, whole, spec
    samplers = {t: DerivativeSampler(param, integrator_specs.build_term(spec, t), sensor, spp, groups)
                for t in terms}
    for sampler in samplers.values():
        if hasattr(whole, "memory"):
            sampler.integrator.memory = whole.memory      # edge tables, and what has been warned about
    return samplers, whole, spec


def differentiable(spec: dict[str, Any]) -> Any:
    """Instantiate `spec`, which must be an integrator."""
    built = integrator_specs.build(spec)
    if not isinstance(built, mi.Integrator):
        raise OptionError(f"'{spec['type']}' is a {type(built).__name__}, not an integrator")
    return built


def _report_not_finite(samplers: dict[str, DerivativeSampler]) -> int:
    lost = {k: s.not_finite for k, s in samplers.items() if s.not_finite}
    if lost:
        warnings.warn(f"derivative pixels that were not finite counted as 0: {lost}", RuntimeWarning,
                      stacklevel=3)
    return sum(lost.values())
