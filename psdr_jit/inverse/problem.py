"""One optimisation as a whole: scenes, views, variables, loss. Evaluates loss and gradient, and does not step."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import require_samples
from psdr_jit.core.upload import in_memory
from psdr_jit.derivative.integrator_specs import aovs_of
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse.control_variate import Single
from psdr_jit.inverse.losses import Loss, find_loss
from psdr_jit.inverse.parts import Part, Stage, begun, parts_of
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.targets import View, views
from psdr_jit.inverse.variables import Variable
from psdr_jit.scene.guard import require_derivatives, require_scene
from psdr_jit.scene.params import is_transform, parameter_value

Latents = dict[str, dict[str, Any]]  # by parameter, by latent

#: What a seed is for; the iteration, the view and this make it.
TARGET_IMAGE, SECOND_IMAGE, GRADIENT = range(3)
IMAGES = (TARGET_IMAGE, SECOND_IMAGE)


@dataclass(frozen=True)
class Problem:
    """Scenes whose `variables` are to make every sensor see its target."""

    parts: tuple[Part, ...]
    views: tuple[View, ...]
    variables: dict[str, Variable]  # by parameter; of the first scene that each acts on
    loss: Loss
    settings: Settings
    own: Latents  # at the scene's own values
    fingerprint: str  # changes with whatever makes a stored state meaningless; targets apart
    target_means: np.ndarray  # by view: renders of one target may differ by rounding
    crew: Any = None  # workers that evaluate it, see `remote`

    @property
    def scene(self) -> mi.Scene:
        """The first one."""
        return self.parts[0].scene

    @property
    def params(self) -> Any:
        """Parameters of the first scene."""
        return self.parts[0].params

    @property
    def integrator(self) -> Any:
        """Of the first scene."""
        return self.parts[0].integrator

    def home(self, name: str) -> Part:
        """The first scene that a variable acts on."""
        return next(part for part in self.parts if name in part.variables)

    def value(self, name: str) -> Any:
        """The parameter that follows from a variable, in its first scene."""
        home = self.home(name)
        return home.params[home.variables[name].parameter]

    def node(self, name: str) -> Any:
        """The object that this parameter belongs to."""
        home = self.home(name)
        return home.params.properties[home.variables[name].parameter][2]

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
        """Put the scenes where the latents say; attached if they are."""
        for part in self.parts:
            for name, variable in part.variables.items():
                part.params[variable.parameter] = in_memory(variable.value(latents[name]))
                # equal values are skipped, but an attached one must replace a detached one
                part.params.set_dirty(variable.parameter)
            part.params.update()

    def factor(self, view: int, chosen: Sequence[int]) -> float:
        """Of a view's loss in that of an iteration which sees the `chosen` ones; right on average over these."""
        return self.views[view].share * len(self.views) / len(chosen)

    def evaluate(self, iteration: int, estimates: Single | None = None) -> tuple[float, dict[int, np.ndarray]]:
        """Loss of the views of an iteration; its gradient is added to that of the scene's parameters.

        `estimates`: how the images are found that the loss sees; unless given, each is rendered by itself.

        All views see one state of the scenes. Their gradients meet in the parameters, and only then go on to the
        latents: else the first view would use up the graph between them. A loss that is not finite, or whose
        derivative by the image is not, ends this with NaN and leaves the rest undone.
        """
        estimates = estimates or Single()
        if self.crew is not None:
            return self.crew.evaluate(self, iteration, estimates)
        total, images = 0.0, {}
        chosen = self.chosen(iteration)
        with dr.isolate_grad():
            for k in chosen:
                loss, image, grad = self._view(iteration, k, estimates)
                images[k] = image
                if not (np.isfinite(loss) and dr.all(dr.isfinite(grad), axis=None)):
                    return float("nan"), images
                part, factor = self.parts[self.views[k].part], self.factor(k, chosen)
                total += loss * factor
                part.integrator.render_backward(
                    part.scene, part.params, grad * factor, sensor=self.views[k].sensor,
                    seed=self.seed(iteration, k, GRADIENT), spp=self.settings.gradient_spp or self.settings.spp,
                )  # fmt: skip
        return total, images

    def _view(self, iteration: int, k: int, estimates: Single) -> tuple[float, np.ndarray, mi.TensorXf]:
        """Loss of one view, its image, and the derivative of the loss by the image."""
        images = []
        for purpose in IMAGES[: self.loss.images]:
            seeds = estimates.seeds(self.seed, iteration, (k, purpose))
            images.append(estimates.estimate((k, purpose), [self._image(k, seed) for seed in seeds]))
        loss, grad = self.loss_of(k, images)
        return loss, np.array(dr.detach(images[0])), grad

    def _image(self, k: int, seed: int) -> mi.TensorXf:
        """One view, rendered, detached."""
        part = self.parts[self.views[k].part]
        with dr.suspend_grad():
            image = part.integrator.render(part.scene, self.views[k].sensor, seed=seed, spp=self.settings.spp)
            return mi.TensorXf(dr.detach(image))

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
    scene: mi.Scene | Sequence[Stage],
    variables: Sequence[Variable] | Variable,
    targets: Any,
    loss: Any,
    integrator: Any,
    settings: Settings,
) -> Problem:
    """Everything checked; raises typed errors before anything is rendered in a loop.

    `scene`: one, with its `targets`, or a list of stages, which have targets of their own.
    """
    require_derivatives()
    stages = _stages(scene, targets)
    chosen = list(variables) if isinstance(variables, Sequence) else [variables]
    if not chosen:
        raise OptionError("there is no variable: name at least one scene parameter to optimise")
    parts = parts_of(chosen, stages, integrator)
    found = tuple(view for k, stage in enumerate(stages) for view in _views(k, stage, parts[k]))
    for view in found:
        require_samples(view.sensor, max(settings.spp, settings.gradient_spp))
    own = begun(parts)
    for variable in chosen:
        for latent, rate in variable.learning_rates.items():
            if not 0 < rate < np.inf:
                raise OptionError(
                    f"'{variable.parameter}': the learning rate of its {latent} must be above 0 and finite, got {rate}"
                )
    by_name = {v.parameter: next(p.variables[v.parameter] for p in parts if v.parameter in p.variables) for v in chosen}
    loss = find_loss(loss)
    digest = _fingerprint(parts, by_name, found, loss, settings)
    means = np.array([np.mean(np.array(view.target)) for view in found])
    return Problem(parts, found, by_name, loss, settings, own, digest, means)


def _stages(scene: Any, targets: Any) -> list[Stage]:
    if isinstance(scene, Sequence):
        if targets is not None:
            raise OptionError("several scenes have targets each: give them to psdr_jit.Stage, and none beside")
        return list(scene)
    require_scene(scene)
    return [Stage(scene, targets)]


def _views(k: int, stage: Stage, part: Part) -> list[View]:
    """Views of a scene; its loss is their mean."""
    found = views(stage.scene, stage.targets, aovs_of(part.integrator))
    return [replace(view, part=k, share=stage.weight / len(found), name=part.label(view.name)) for view in found]


def _fingerprint(parts: Sequence[Part], variables: Any, found: Sequence[View], loss: Loss, settings: Settings) -> str:
    """Of everything that was asked for, and of the scenes."""
    ignored = {"iterations", "checkpoint_every", "snapshot_every", "max_seconds"}  # may change on resuming
    asked = {key: value for key, value in asdict(settings).items() if key not in ignored}
    kinds = {name: [type(v).__name__, _asked(v), dict(v.learning_rates)] for name, v in variables.items()}
    digest = hashlib.sha256()
    whole = [asked, kinds, [view.name for view in found], loss.name, *(str(part.integrator) for part in parts)]
    if len(parts) > 1:
        whole.append([[part.name, list(part.variables)] for part in parts])
        whole.append([view.share for view in found])
    digest.update(json.dumps(whole, sort_keys=True, default=str).encode())
    for part in parts:
        for name in sorted(part.params.keys()):
            value = parameter_value(part.params, name)
            value = value.matrix if is_transform(value) else value
            digest.update(name.encode())
            digest.update(np.array(dr.detach(value)).tobytes() if dr.is_array_v(value) else repr(value).encode())
    return digest.hexdigest()


def _asked(variable: Variable) -> dict[str, Any]:
    """What a variable was made with."""
    if not is_dataclass(variable):
        return {}
    return {f.name: getattr(variable, f.name) for f in fields(variable) if f.init}
