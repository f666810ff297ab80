"""Loss and gradient of an iteration by workers: a unit is the image, or the gradient, of one view.

The caller keeps latents, variables, losses and optimisers. Workers get the values of the scene's parameters and return
the gradient by these, which are added up in the order of the views and then go on to the latents: any number of workers
steps alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.cluster.engine import Engine, together
from psdr_jit.cluster.values import from_numpy, to_numpy
from psdr_jit.cluster.worker import Held
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.make_plan import make_plan
from psdr_jit.derivative.remote import Spec, integrator_of, sensor_index
from psdr_jit.derivative.sampler import TOTAL
from psdr_jit.errors import OptionError
from psdr_jit.inverse.control_variate import Single
from psdr_jit.inverse.problem import GRADIENT, IMAGES, Problem
from psdr_jit.scene.names import traverse
from psdr_jit.scene.params import is_transform


def image_unit(held: Held, spec: Spec, view: tuple[int, int, int]) -> np.ndarray:
    """On a worker: the image of one view; `view`: sensor, spp, seed."""
    sensor, spp, seed = view
    integrator = integrator_of(held, spec, TOTAL)
    with dr.suspend_grad():
        return np.array(dr.detach(integrator.render(held.scene, held.scene.sensors()[sensor], seed=seed, spp=spp)))


def gradient_unit(held: Held, names: Sequence[str], spec: Spec, grad: np.ndarray,
                  view: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """On a worker: derivative of <grad, image> by parameters, of poses by the entries of their matrices."""
    sensor, spp, seed = view
    params = traverse(held.scene, names)
    before = {name: type(params[name])(dr.detach(params[name])) for name in names}
    leaves = {name: value.matrix if is_transform(value) else type(value)(value) for name, value in before.items()}
    leaves = {name: type(leaf)(leaf) for name, leaf in leaves.items()}
    try:
        for name, leaf in leaves.items():
            dr.enable_grad(leaf)
            _write(params, name, type(before[name])(leaf))
        params.update()
        integrator_of(held, spec, TOTAL).render_backward(
            held.scene, params, mi.TensorXf(np.array(grad)), sensor=held.scene.sensors()[sensor], seed=seed, spp=spp
        )
        return {name: _shaped(before[name], np.array(dr.grad(leaf))) for name, leaf in leaves.items()}
    finally:
        for name, value in before.items():
            _write(params, name, value)
        params.update()


def _write(params: Any, name: str, value: Any) -> None:
    params[name] = value
    params.set_dirty(name)


def _shaped(value: Any, grad: np.ndarray) -> np.ndarray:
    return grad.reshape(grad.shape[:2]) if is_transform(value) else grad


class _Hands:
    """Workers for one scene of a problem. With a plan, form and samples per term are those of a pilot at the start."""

    def __init__(self, client: Any, problem: Problem, k: int, integrator: Any) -> None:
        part = problem.parts[k]
        self.engine = Engine(client, part.scene, part.source, at_once=len(problem.parts))
        self.part, self.names = part, [variable.parameter for variable in part.variables.values()]
        self.sensors = {view: sensor_index(part.scene, found.sensor)
                        for view, found in enumerate(problem.views) if found.part == k}  # fmt: skip
        self.spp = problem.settings.gradient_spp or problem.settings.spp
        self.spec = integrator_specs.integrator_spec(part.scene, integrator)
        table = integrator_specs.term_table(self.spec["type"])
        own = {"plan", *(budget for _, budget in table)} & self.spec.keys()
        if self.spec["type"] in integrator_specs.OURS and not own and self.names:
            first = next(iter(self.sensors.values()))
            plan = make_plan(part.scene, self.names, first, self.spec, self.spp)
            budgets = {budget: plan.term(name).spp or self.spp for name, budget in table}
            self.spec |= {"form": plan.form, **budgets}
            self.spp = 0  # those of the terms

    def update(self) -> None:
        """Let them see the parameters as they are now."""
        self.engine.update({name: to_numpy(self.part.params[name]) for name in self.names})


class Crew:
    """Workers that evaluate a problem."""

    def __init__(self, client: Any, problem: Problem, integrator: Any) -> None:
        if hasattr(integrator, "render_backward"):
            raise OptionError("workers make integrators of their own: give its properties as a dict, or its name")
        self._hands = [_Hands(client, problem, k, integrator) for k in range(len(problem.parts))]

    def evaluate(self, problem: Problem, iteration: int, estimates: Single) -> tuple[float, dict[int, np.ndarray]]:
        """See `Problem.evaluate`."""
        chosen = problem.chosen(iteration)
        for hands in self._hands:
            hands.update()
        images = self._images(problem, iteration, chosen, estimates)
        total, units = 0.0, []
        for k in chosen:
            loss, grad = problem.loss_of(k, images[k])
            if not (np.isfinite(loss) and dr.all(dr.isfinite(grad), axis=None)):
                return float("nan"), {k: np.array(images[k][0]) for k in chosen}
            factor, hands = problem.factor(k, chosen), self._of(problem, k)
            total += loss * factor
            view = hands.sensors[k], hands.spp, problem.seed(iteration, k, GRADIENT)
            units.append((hands.engine, (hands.names, hands.spec, np.array(grad * factor), view)))
        sums = [dict.fromkeys(hands.names, 0.0) for hands in self._hands]
        for k, found in zip(chosen, together(gradient_unit, units), strict=True):
            part = sums[problem.views[k].part]
            part |= {name: part[name] + grad.astype(np.float64) for name, grad in found.items()}
        for hands, grads in zip(self._hands, sums, strict=True):
            for name, grad in grads.items():
                if isinstance(grad, np.ndarray):  # some view of this scene was seen
                    _go_on(hands.part.params[name], grad)
        return total, {k: np.array(images[k][0]) for k in chosen}

    def _of(self, problem: Problem, view: int) -> _Hands:
        return self._hands[problem.views[view].part]

    def _images(self, problem: Problem, iteration: int, chosen: Sequence[int],
                estimates: Single) -> dict[int, list[mi.TensorXf]]:
        """Images by view, as many as the loss wants to see."""
        keys = [(k, purpose) for k in chosen for purpose in IMAGES[: problem.loss.images]]
        seeds = {key: estimates.seeds(problem.seed, iteration, key) for key in keys}
        units = []
        for k, purpose in keys:
            hands = self._of(problem, k)
            views = [(hands.sensors[k], problem.settings.spp, seed) for seed in seeds[k, purpose]]
            units += [(hands.engine, (hands.spec, view)) for view in views]
        found, images = together(image_unit, units), {k: [] for k in chosen}
        for key in keys:
            rendered = [mi.TensorXf(np.array(next(found))) for _ in seeds[key]]
            images[key[0]].append(estimates.estimate(key, rendered))
        return images


def _go_on(value: Any, grad: np.ndarray) -> None:
    """Backward from a parameter of the scene to the latents that it follows from."""
    if is_transform(value):
        n = len(grad)
        dr.backward(sum(value.matrix[i, j] * float(grad[i, j]) for i in range(n) for j in range(n)))
    else:
        dr.backward(dr.sum(value * from_numpy(dr.detach(value), grad), axis=None))


def with_crew(problem: Problem, client: Any, integrator: Any) -> Problem:
    """The problem, evaluated by the workers of a Dask client, who must know where its scenes are from."""
    return replace(problem, crew=Crew(client, problem, integrator))
