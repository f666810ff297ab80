"""Derivatives by workers: the units that they do, and the same samplers as here, made of such units.

A unit depends on nothing but its arguments: the plan, with form and budgets, is made once and travels with it. So any
number of workers, and whoever does which unit, gives the same images.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.cluster.engine import Engine
from psdr_jit.cluster.worker import Held
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.make_plan import make_plan
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.sampler import PRIMAL, TOTAL, DerivativeSampler, differentiable
from psdr_jit.errors import OptionError
from psdr_jit.plan.plan import Plan

Spec = dict[str, Any]


def derivative_unit(held: Held, name: str, how: dict, spec: Spec, term: str, view: tuple[int, int, int]) -> tuple:
    """On a worker: `(image, values not finite, samples rejected)` of one term; `view`: sensor, spp, seed."""
    sensor, spp, seed = view
    integrator = integrator_of(held, spec, term)
    if term == PRIMAL:
        with dr.suspend_grad():
            image = integrator.render(held.scene, held.scene.sensors()[sensor], seed=seed, spp=spp)
        return integrator_specs.to_image(image).astype(np.float32), 0, 0
    before = integrator_specs.rejected(integrator)
    sampler = DerivativeSampler(perturb(held.scene, name, **how), integrator, sensor, spp)
    (image,) = sampler.rendered(range(seed, seed + 1))
    after = integrator_specs.rejected(integrator)
    # images are of single precision, so nothing is lost
    return image.astype(np.float32), sampler.not_finite, None if after is None else after - (before or 0)


def difference_unit(held: Held, name: str, how: dict, spec: Spec, step: tuple[int, int, float], seed: int) -> tuple:
    """On a worker: central difference of one seed, and the image on its upper side; `step`: sensor, spp, eps."""
    sensor, spp, eps = step
    difference = CentralDifference(perturb(held.scene, name, **how), spec, sensor, spp, eps, groups=1)
    (image,) = difference.differences([seed])
    return image, difference.primal.mean()


def integrator_of(held: Held, spec: Spec, term: str) -> Any:
    """Made once per scene and kept: integrators of single terms share what they know of the scene."""
    key = json.dumps(spec, sort_keys=True)
    kept = held.kept.setdefault(key, {})
    if not kept:
        kept[TOTAL] = kept[PRIMAL] = differentiable(spec)
    if term not in kept:
        kept[term] = integrator_specs.build_term(spec, term)
        if hasattr(kept[TOTAL], "memory"):
            kept[term].memory = kept[TOTAL].memory
    return kept[term]


def with_plan(param: Perturbation, integrator: Any, sensor: int, spp: int, equal: bool) -> Spec:
    """The spec with a plan that all workers follow; `equal`: as many samples for each term, instead of by noise."""
    if hasattr(integrator, "render_forward"):
        raise OptionError("workers make integrators of their own: give its properties as a dict, or its name")
    spec = integrator_specs.integrator_spec(param.scene, integrator)
    differentiable(spec)  # raises here what it would there
    given = spec.get("plan", "lean")
    if isinstance(given, Plan):
        return {**spec, "plan": given.to_json()}
    if spec["type"] not in integrator_specs.OURS or given.lstrip().startswith("{") or spec.get("direction") == "known":
        return spec
    terms = integrator_specs.terms_of(spec)
    table = integrator_specs.term_table(spec["type"])
    budgets = {budget: spp if name in terms else 0 for name, budget in table} if equal else {}
    return {**spec, "plan": make_plan(param.scene, param.name, sensor, {**spec, **budgets}, spp).to_json()}


def _asked(param: Perturbation) -> tuple[str, dict]:
    if not param.how:
        raise OptionError(f"the curve of '{param.name}' cannot travel to workers: make it with psdr_jit's perturb")
    return param.name, param.how


def sensor_index(scene: Any, sensor: Any) -> int:
    """Raises `OptionError` for a sensor that is not the scene's own."""
    if not isinstance(sensor, mi.Sensor):
        return int(sensor)
    for k, own in enumerate(scene.sensors()):
        if own is sensor:
            return k
    raise OptionError("workers know the scene's own sensors only: give the index of one")


class RemoteTerms:
    """Every term of an integrator alone, rendered by workers, and the primal image: see `sampler.Terms`."""

    def __init__(self, engine: Engine, param: Perturbation, integrator: Any, sensor: Any, spp: int) -> None:
        self._engine, self._asked = engine, _asked(param)
        self._sensor, self._spp = sensor_index(param.scene, sensor), spp
        self._shipped = with_plan(param, integrator, self._sensor, spp, equal=True)
        self.spec = integrator_specs.integrator_spec(param.scene, integrator)
        self.names = tuple(integrator_specs.terms_of(self.spec)) or (TOTAL,)
        self.not_finite: dict[str, int] = {}
        self.rejected: int | None = 0

    def images(self, seeds: int) -> Iterator[dict[str, np.ndarray]]:
        """For each seed: images by name of the term, and `PRIMAL`."""
        every = (PRIMAL, *self.names)
        units = [(*self._asked, self._shipped, term, (self._sensor, self._spp, seed))
                 for seed in range(seeds) for term in every]  # fmt: skip
        results = self._engine.ordered(derivative_unit, units)
        for _ in range(seeds):
            yield {term: self._counted(term, *next(results)) for term in every}

    def _counted(self, term: str, image: np.ndarray, not_finite: int, rejected: int | None) -> np.ndarray:
        if not_finite:
            self.not_finite[term] = self.not_finite.get(term, 0) + not_finite
        self.rejected = None if rejected is None or self.rejected is None else self.rejected + rejected
        return image.astype(np.float64)


class RemoteSampler(DerivativeSampler):
    """Derivative images by all terms together, rendered by workers."""

    def __init__(self, engine: Engine, perturbation: Perturbation, integrator: Any, sensor: int, spp: int) -> None:
        spec = with_plan(perturbation, integrator, sensor, spp, equal=False)
        super().__init__(perturbation, None, sensor, spp)
        self._engine, self._unit = engine, (*_asked(perturbation), spec, TOTAL)
        self._index = sensor
        self.at_once = engine.workers

    def rendered(self, seeds: range) -> Iterator[np.ndarray]:
        units = [(*self._unit, (self._index, self.spp, seed)) for seed in seeds]
        for image, not_finite, _ in self._engine.ordered(derivative_unit, units):
            self.not_finite += not_finite
            yield image.astype(np.float64)


class RemoteDifference(CentralDifference):
    """Central differences, rendered by workers."""

    def __init__(self, engine: Engine, perturbation: Perturbation, spec: Spec, sensor: int, spp: int | None,
                 eps: float | None) -> None:
        super().__init__(perturbation, spec, sensor, spp, eps)
        options = {key: value for key, value in spec.items() if key != "plan"}  # a reference has none
        self._engine, self._unit = engine, (*_asked(perturbation), options, (sensor, self.spp, self.eps))
        self.at_once = engine.workers

    def differences(self, seeds: Sequence[int]) -> list[np.ndarray]:
        found = list(self._engine.ordered(difference_unit, [(*self._unit, seed) for seed in seeds]))
        for _, above in found:
            self.note_primal(above)
        return [image for image, _ in found]
