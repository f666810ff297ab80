"""Derivative images of independent seeds, and the same of every term of an integrator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import require_samples
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation
from psdr_jit.derivative.statistics import GroupedImages
from psdr_jit.errors import OptionError
from psdr_jit.scene.io import find_sensor

PRIMAL, TOTAL = "primal", "total"  # beside the names of terms


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

    #: Seeds that are rendered at the same time.
    at_once = 1

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
        first, self._next_seed = self._next_seed, self._next_seed + seeds
        for image in self.rendered(range(first, first + seeds)):
            self.images.add(image)
        self.seconds += time.perf_counter() - start

    def rendered(self, seeds: range) -> Iterator[np.ndarray]:
        """The images of these seeds, in order; leaves the scene as it was found."""
        yield from map(self.render, seeds)
        self.perturbation.restore()


def differentiable(spec: dict[str, Any]) -> Any:
    """Instantiate `spec`, which must be an integrator."""
    built = integrator_specs.build(spec)
    if not isinstance(built, mi.Integrator):
        raise OptionError(f"'{spec['type']}' is a {type(built).__name__}, not an integrator")
    return built


class Terms:
    """Every term of an integrator alone, rendered here, and the primal image."""

    def __init__(self, param: Perturbation, integrator: Any, sensor: Any, spp: int) -> None:
        self._param, self._spp = param, spp
        self._view = find_sensor(param.scene, sensor)
        self._samplers, self._whole, self.spec = _samplers(param, integrator, sensor, spp)
        self.names = tuple(self._samplers)

    def images(self, seeds: int) -> Iterator[dict[str, np.ndarray]]:
        """For each seed: images by name of the term, and `PRIMAL`. Leaves the scene as it was found."""
        try:
            for seed in range(seeds):
                with dr.suspend_grad():
                    image = self._whole.render(self._param.scene, self._view, seed=seed, spp=self._spp)
                found = {PRIMAL: integrator_specs.to_image(image)}
                yield found | {name: sampler.render(seed) for name, sampler in self._samplers.items()}
        finally:
            self._param.restore()

    @property
    def not_finite(self) -> dict[str, int]:
        """Pixel values that arrived as NaN or inf, by term that had any."""
        return {name: s.not_finite for name, s in self._samplers.items() if s.not_finite}

    @property
    def rejected(self) -> int | None:
        """Samples that were dropped; None where they are not counted."""
        counts = [integrator_specs.rejected(s.integrator) for s in self._samplers.values()]
        return None if None in counts else sum(counts)


def _samplers(param: Perturbation, integrator: Any, sensor: Any, spp: int) -> tuple[dict[str, DerivativeSampler], Any,
                                                                                    dict[str, Any]]:
    """One sampler for each term (or one named `TOTAL`), the integrator of the primal image, and the spec."""
    if hasattr(integrator, "render_forward"):
        spec = {"type": str(integrator).split("[")[0], **integrator_specs.path_options(integrator)}
        if integrator_specs.aovs_of(integrator):
            spec["aovs"] = integrator.options.aovs
        return {TOTAL: DerivativeSampler(param, integrator, sensor, spp)}, integrator, spec
    spec = integrator_specs.integrator_spec(param.scene, integrator)
    whole = differentiable(spec)
    terms = integrator_specs.terms_of(spec)
    if not terms:
        return {TOTAL: DerivativeSampler(param, whole, sensor, spp)}, whole, spec
    samplers = {t: DerivativeSampler(param, integrator_specs.build_term(spec, t), sensor, spp) for t in terms}
    for sampler in samplers.values():
        if hasattr(whole, "memory"):
            sampler.integrator.memory = whole.memory      # edge tables, and what has been warned about
    return samplers, whole, spec
