"""Several scenes in one loss: what is asked of each, and which variable acts on which of them.

Losses of the scenes add up, times their weights. A variable named by a parameter ("box.vertex_positions") acts on every
scene that has it: its latents are shared, and where a scene stood at first is that scene's own matter, so that a pose
shifts a body from wherever each scene has it. With the name of a scene before it ("evening:lamp.position") it acts on
that one alone.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse.variables import Variable, numbers
from psdr_jit.scene.guard import require_integrator, require_scene
from psdr_jit.scene.names import stable_name, traverse

NAME = re.compile(r"[\w.-]+")  # of a scene: it is part of file names


@dataclass(frozen=True)
class Stage:
    """One scene of several that `psdr_jit.optimize` is given, and what its sensors should see.

    `targets`: as for one scene alone. `weight`: of its loss in the sum. `name`: for names of files and of variables
    that act on this scene only; its number unless given. `source`: the `SceneFile` that it was loaded from.
    """

    scene: mi.Scene
    targets: Any
    weight: float = 1.0
    name: str = ""
    source: Any = None


@dataclass(frozen=True)
class Part:
    """A scene at work in a problem. `variables`: those that act on it, by their names in the problem."""

    name: str  # "" if it is the only one
    scene: mi.Scene
    params: Any
    variables: dict[str, Variable]
    integrator: Any
    source: Any

    def label(self, name: str, between: str = "_") -> str:
        """A name that no other scene of the problem has."""
        return f"{self.name}{between}{name}" if self.name else name


def named(stages: Sequence[Stage]) -> list[str]:
    """Names of the scenes; "" for one alone. Raises `OptionError` for stages that cannot be told apart, or weighed."""
    if not stages or not all(isinstance(stage, Stage) for stage in stages):
        raise OptionError("several scenes are given as a list of psdr_jit.Stage(scene, targets)")
    for stage in stages:
        require_scene(stage.scene)
        if not (isinstance(stage.weight, (int, float)) and 0 < stage.weight < np.inf):
            raise OptionError(f"weight = {stage.weight!r} of a scene: expected a number above 0")
    names = [stage.name or str(k) for k, stage in enumerate(stages)] if len(stages) > 1 else [""]
    bad = [name for name in names if len(stages) > 1 and (not NAME.fullmatch(name) or names.count(name) > 1)]
    if bad:
        raise OptionError(f"a scene is called '{bad[0]}': give each another name, of letters, digits, '_', '-' and '.'")
    return names


def bound(variables: Sequence[Variable], stages: Sequence[Stage], names: Sequence[str]) -> list[dict[str, Variable]]:
    """By scene: the variables that act on it, each with the name of the parameter there."""
    found: list[dict[str, Variable]] = [{} for _ in stages]
    taken: list[set[str]] = [set() for _ in stages]
    for variable in variables:
        only, colon, rest = str(variable.parameter).partition(":")
        chosen = colon and only in names and len(stages) > 1
        parameter = rest if chosen else variable.parameter
        places = [names.index(only)] if chosen else _having(parameter, stages)
        for k in places or [0]:  # where it is nowhere, the first says so
            key = stable_name(stages[k].scene, parameter)
            if key in taken[k]:
                raise OptionError(f"parameter '{key}' belongs to several variables; give each parameter one")
            taken[k].add(key)
            found[k][variable.parameter] = variable if len(stages) == 1 else _for(variable, parameter)
    return found


def _having(parameter: Any, stages: Sequence[Stage]) -> list[int]:
    return [k for k, stage in enumerate(stages) if stable_name(stage.scene, parameter) in traverse(stage.scene)]


def _for(variable: Variable, parameter: str) -> Variable:
    """A variable of its own for one scene: it remembers where that one stands."""
    own = copy.copy(variable)
    own.parameter = parameter
    return own


def parts_of(variables: Sequence[Variable], stages: Sequence[Stage], integrator: Any) -> tuple[Part, ...]:
    """The scenes, ready to be rendered."""
    require_integrator(integrator)
    made = hasattr(integrator, "render_backward")
    if made and len(stages) > 1:
        raise OptionError("each of several scenes has an integrator of its own: give properties as a dict, or a name")
    names = named(stages)
    found = []
    for stage, name, own in zip(stages, names, bound(variables, stages, names), strict=True):
        params = traverse(stage.scene, [v.parameter for v in own.values()])
        spec = integrator if made else integrator_specs.integrator_spec(stage.scene, integrator)
        built = integrator if made else integrator_specs.build(spec)
        found.append(Part(name, stage.scene, params, own, built, stage.source))
    return tuple(found)


def begun(parts: Sequence[Part]) -> dict[str, dict[str, Any]]:
    """Latents at the scenes' own values, by variable: of the first scene that it acts on."""
    own: dict[str, dict[str, Any]] = {}
    for part in parts:
        for name, variable in part.variables.items():
            latents = variable.begin(part.scene, part.params)
            _require_alike(name, own.setdefault(name, latents), latents)
    return own


def _require_alike(name: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    sizes = [{key: numbers(value).shape for key, value in latents.items()} for latents in (one, other)]
    if sizes[0] != sizes[1]:
        raise ParameterError(
            f"'{name}' is not the same in all scenes ({sizes[0]} and {sizes[1]} numbers): name the scene that is "
            f"meant, as in 'SCENE:{name}'"
        )
