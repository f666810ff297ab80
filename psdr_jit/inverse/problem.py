"""One optimisation as a whole: scene, views, variables, loss. Evaluates loss and gradient, and does not step."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import require_samples
from psdr_jit.core.upload import in_memory
from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse.losses import Loss, find_loss
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.targets import View, views
from psdr_jit.inverse.variables import Variable
from psdr_jit.scene.guard import require_derivatives, require_integrator, require_scene
from psdr_jit.scene.names import stable_name, traverse
from psdr_jit.scene.params import is_transform, parameter_value

Latents = dict[str, dict[str, Any]]  # by parameter, by latent

#: What a seed is for; the iteration, the view and this make it.
TARGET_IMAGE, SECOND_IMAGE, GRADIENT = range(3)
IMAGES = (TARGET_IMAGE, SECOND_IMAGE)


@dataclass(frozen=True)
class Problem:
    """A scene whose `variables` are to make every sensor see its target."""

    scene: mi.Scene
    params: Any
    views: tuple[View, ...]
    variables: dict[str, Variable]  # by parameter
    loss: Loss
    integrator: Any
    settings: Settings
    own: Latents  # at the scene's own values
    fingerprint: str  # changes with whatever makes a stored state meaningless; targets apart
    target_means: np.ndarray  # by view: renders of one target may differ by rounding
    source: Any = None  # the `SceneFile` that the scene was loaded from, if known
    crew: Any = None  # workers that evaluate it, see `remote`

    @property
    def period(self) -> int:
        """Iterations in which every view is seen."""
        few = self.settings.views_per_step
        return 1 if few == 0 else -(-len(self.views) // few)

    def rate(self, iteration: int) -> float:
        """Factor of the learning rates: 1 in the first iteration, `decay` in the last."""
        last = max(1, self.settings.iterations - 1)
        return self.settings.decay ** (iteration / last)

    def chosen(self, iteration: int) -> list[int]:
        """Views of an iteration: all, or the next few of a random order that is drawn anew for each round."""
        count, few = len(self.views), self.settings.views_per_step
        if few == 0 or few >= count:
            return list(range(count))
        picked = []
        for k in range(iteration * few, (iteration + 1) * few):
            order = np.random.default_rng((self.settings.seed, k // count)).permutation(count)
            picked.append(int(order[k % count]))
        return picked

    def seed(self, iteration: int, view: int, purpose: int) -> int:
        """A seed for Mitsuba's samplers."""
        state = np.random.SeedSequence((self.settings.seed, iteration, view, purpose)).generate_state(1)
        return int(state[0])

    def apply(self, latents: Mapping[str, Mapping[str, Any]]) -> None:
        """Put the scene where the latents say; attached if they are."""
        for name, variable in self.variables.items():
            self.params[name] = in_memory(variable.value(latents[name]))
            self.params.set_dirty(name)  # equal values are skipped, but an attached one must replace a detached one
        self.params.update()

    def evaluate(self, iteration: int) -> tuple[float, dict[int, np.ndarray]]:
        """Loss of the views of an iteration; its gradient is added to that of the scene's parameters.

        All views see one state of the scene. Their gradients meet in its parameters, and only then go on to the
        latents: else the first view would use up the graph between them. A loss that is not finite, or whose
        derivative by the image is not, ends this with NaN and leaves the rest undone.
        """
        if self.crew is not None:
            return self.crew.evaluate(self, iteration)
        total, images = 0.0, {}
        chosen = self.chosen(iteration)
        with dr.isolate_grad():
            for k in chosen:
                loss, image, grad = self._view(iteration, k)
                images[k] = image
                if not (np.isfinite(loss) and dr.all(dr.isfinite(grad), axis=None)):
                    return float("nan"), images
                total += loss / len(chosen)
                self.integrator.render_backward(
                    self.scene, self.params, grad / len(chosen), sensor=self.views[k].sensor,
                    seed=self.seed(iteration, k, GRADIENT), spp=self.settings.gradient_spp or self.settings.spp,
                )  # fmt: skip
        return total, images

    def _view(self, iteration: int, k: int) -> tuple[float, np.ndarray, mi.TensorXf]:
        """Loss of one view, its image, and the derivative of the loss by the image."""
        images = []
        with dr.suspend_grad():
            for purpose in IMAGES[: self.loss.images]:
                image = self.integrator.render(self.scene, self.views[k].sensor, seed=self.seed(iteration, k, purpose),
                                               spp=self.settings.spp)  # fmt: skip
                images.append(mi.TensorXf(dr.detach(image)))
        loss, grad = self.loss_of(k, images)
        return loss, np.array(dr.detach(images[0])), grad

    def loss_of(self, k: int, images: list[mi.TensorXf]) -> tuple[float, mi.TensorXf]:
        """Loss of one view that looks like `images`, and its derivative by these, added up."""
        dr.enable_grad(images)
        loss = self.loss.function(*images, self.views[k].target)
        if not dr.is_array_v(loss) or not dr.grad_enabled(loss):
            raise ParameterError(
                f"the loss '{self.loss.name}' does not depend on the image: compute it with Dr.Jit functions "
                "(NumPy and PyTorch are not tracked; see dr.wrap)"
            )
        if dr.width(loss) != 1:
            raise ParameterError(
                f"the loss '{self.loss.name}' returned {type(loss).__name__} with {dr.width(loss)} numbers: expected "
                "one, such as dr.mean(..., axis=None)"
            )
        dr.backward(loss)
        grad = sum(dr.grad(image) for image in images)
        dr.eval(loss, grad)
        return float(np.ravel(np.array(dr.detach(loss)))[0]), grad

    def offsets(self, latents: Latents) -> dict[str, dict[str, float]]:
        """How far every variable is from the scene's own value."""
        return {name: variable.offset(latents[name]) for name, variable in self.variables.items()}

    def start(self) -> Latents:
        """Latents to start from."""
        seed = self.settings.perturb
        found = {}
        for k, (name, variable) in enumerate(self.variables.items()):
            rng = None if seed is None else np.random.default_rng((seed, k))
            found[name] = variable.start(self.own[name], rng)
        return copied(found)  # the optimisers must not step the scene's own values


def copied(latents: Mapping[str, Mapping[str, Any]]) -> Latents:
    """Detached copies."""
    return {name: {k: type(v)(dr.detach(v)) for k, v in found.items()} for name, found in latents.items()}


def make_problem(
    scene: mi.Scene,
    variables: Sequence[Variable] | Variable,
    targets: Any,
    loss: Any,
    integrator: Any,
    settings: Settings,
) -> Problem:
    """Everything checked; raises typed errors before anything is rendered in a loop."""
    require_derivatives()
    require_scene(scene)
    chosen = list(variables) if isinstance(variables, Sequence) else [variables]
    names = [v.parameter for v in chosen]
    if not chosen:
        raise OptionError("there is no variable: name at least one scene parameter to optimise")
    keys = [stable_name(scene, name) for name in names]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise OptionError(f"parameter '{twice[0]}' belongs to several variables; give each parameter one")
    found = tuple(views(scene, targets))
    for view in found:
        require_samples(view.sensor, max(settings.spp, settings.gradient_spp))
    params = traverse(scene, names)
    own = {v.parameter: v.begin(scene, params) for v in chosen}
    for variable in chosen:
        for latent, rate in variable.learning_rates.items():
            if not 0 < rate < np.inf:
                raise OptionError(
                    f"'{variable.parameter}': the learning rate of its {latent} must be above 0 and finite, got {rate}"
                )
    require_integrator(integrator)
    if not hasattr(integrator, "render_backward"):
        integrator = integrator_specs.build(integrator_specs.integrator_spec(scene, integrator))
    by_name = {v.parameter: v for v in chosen}
    loss = find_loss(loss)
    digest = _fingerprint(params, by_name, found, loss, integrator, settings)
    means = np.array([np.mean(np.array(view.target)) for view in found])
    return Problem(scene, params, found, by_name, loss, integrator, settings, own, digest, means)


def _fingerprint(params: Any, variables: Any, found: Any, loss: Loss, integrator: Any, settings: Settings) -> str:
    """Of everything that was asked for, and of the scene."""
    ignored = {"iterations", "checkpoint_every", "snapshot_every", "max_seconds"}  # may change on resuming
    asked = {key: value for key, value in asdict(settings).items() if key not in ignored}
    kinds = {name: [type(v).__name__, _asked(v), dict(v.learning_rates)] for name, v in variables.items()}
    digest = hashlib.sha256()
    whole = [asked, kinds, [view.name for view in found], loss.name, str(integrator)]
    digest.update(json.dumps(whole, sort_keys=True, default=str).encode())
    for name in sorted(params.keys()):
        value = parameter_value(params, name)
        value = value.matrix if is_transform(value) else value
        digest.update(name.encode())
        digest.update(np.array(dr.detach(value)).tobytes() if dr.is_array_v(value) else repr(value).encode())
    return digest.hexdigest()


def _asked(variable: Variable) -> dict[str, Any]:
    """What a variable was made with."""
    if not is_dataclass(variable):
        return {}
    return {f.name: getattr(variable, f.name) for f in fields(variable) if f.init}
