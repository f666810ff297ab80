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

from psdr_jit.cluster.engine import Engine
from psdr_jit.cluster.source import SceneFile
from psdr_jit.cluster.values import from_numpy, to_numpy
from psdr_jit.cluster.worker import Held
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.make_plan import make_plan
from psdr_jit.derivative.remote import Spec, integrator_of, sensor_index
from psdr_jit.derivative.sampler import TOTAL
from psdr_jit.errors import OptionError
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


class Crew:
    """Workers that evaluate a problem. With a plan, form and samples per term are those of a pilot at the start."""

    def __init__(self, engine: Engine, problem: Problem, integrator: Any) -> None:
        if hasattr(integrator, "render_backward"):
            raise OptionError("workers make integrators of their own: give its properties as a dict, or its name")
        self._engine = engine
        self._sensors = [sensor_index(problem.scene, view.sensor) for view in problem.views]
        self._spp = problem.settings.gradient_spp or problem.settings.spp
        self._spec = integrator_specs.integrator_spec(problem.scene, integrator)
        table = integrator_specs.term_table(self._spec["type"])
        own = {"plan", *(budget for _, budget in table)} & self._spec.keys()
        if self._spec["type"] in integrator_specs.OURS and not own:
            plan = make_plan(problem.scene, list(problem.variables), self._sensors[0], self._spec, self._spp)
            budgets = {budget: plan.term(name).spp or self._spp for name, budget in table}
            self._spec |= {"form": plan.form, **budgets}
            self._spp = 0  # those of the terms

    def evaluate(self, problem: Problem, iteration: int) -> tuple[float, dict[int, np.ndarray]]:
        """See `Problem.evaluate`."""
        chosen, names = problem.chosen(iteration), list(problem.variables)
        self._engine.update({name: to_numpy(problem.params[name]) for name in names})
        images = self._images(problem, iteration, chosen)
        total, grads = 0.0, []
        for k in chosen:
            loss, grad = problem.loss_of(k, images[k])
            if not (np.isfinite(loss) and dr.all(dr.isfinite(grad), axis=None)):
                return float("nan"), {k: np.array(images[k][0]) for k in chosen}
            total += loss / len(chosen)
            view = self._sensors[k], self._spp, problem.seed(iteration, k, GRADIENT)
            grads.append((names, self._spec, np.array(grad / len(chosen)), view))
        sums = dict.fromkeys(names, 0.0)
        for found in self._engine.ordered(gradient_unit, grads):
            sums = {name: sums[name] + found[name].astype(np.float64) for name in names}
        for name, grad in sums.items():
            _go_on(problem.params[name], grad)
        return total, {k: np.array(images[k][0]) for k in chosen}

    def _images(self, problem: Problem, iteration: int, chosen: Sequence[int]) -> dict[int, list[mi.TensorXf]]:
        """Images by view, as many as the loss wants to see."""
        purposes = IMAGES[: problem.loss.images]
        units = [(self._spec, (self._sensors[k], problem.settings.spp, problem.seed(iteration, k, purpose)))
                 for k in chosen for purpose in purposes]  # fmt: skip
        found = self._engine.ordered(image_unit, units)
        return {k: [mi.TensorXf(np.array(next(found))) for _ in purposes] for k in chosen}


def _go_on(value: Any, grad: np.ndarray) -> None:
    """Backward from a parameter of the scene to the latents that it follows from."""
    if is_transform(value):
        n = len(grad)
        dr.backward(sum(value.matrix[i, j] * float(grad[i, j]) for i in range(n) for j in range(n)))
    else:
        dr.backward(dr.sum(value * from_numpy(dr.detach(value), grad), axis=None))


def with_crew(problem: Problem, client: Any, source: SceneFile | str | None, integrator: Any) -> Problem:
    """The problem, evaluated by the workers of a Dask client. `source`: where its scene is from."""
    return replace(problem, crew=Crew(Engine(client, problem.scene, source), problem, integrator))
