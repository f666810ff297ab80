"""Which integrator is used when none is named, and how its terms are switched on one at a time.

An integrator is described by its plain properties (a *spec*, the dict that `mi.load_dict` takes), so that
the same scene can be rendered by one term alone or by Mitsuba's `path` under the same path lengths.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import black
from psdr_jit.driver.aovs import AovChannels
from psdr_jit.driver.primal import image_plugin
from psdr_jit.driver.terms import TERMS
from psdr_jit.errors import OptionError
from psdr_jit.options import FOLLOWS
from psdr_jit.paths.aovs import Aovs
from psdr_jit.plan.light_plan import focusing_shapes
from psdr_jit.plan.plan import Plan
from psdr_jit.scene.facts import analyse

DEFAULT_INTEGRATOR = "psdr_path"

# plugins whose derivative is the sum of our terms
OURS = (DEFAULT_INTEGRATOR, "psdr_bdpt")

# Mitsuba's own, for comparisons: term name, its sample budget
PROJECTIVE_TERMS = (("interior", "sppc"), ("primary", "sppp"), ("secondary", "sppi"))

UNKNOWN = 'Plugin "{}" not found'  # how Mitsuba says so
INSIDE = 4  # channels that Mitsuba's `aov` lists for the integrator in it: R, G, B, A

# what the reference has to share with the integrator under test
PATH_OPTIONS = ("max_depth", "rr_depth", "hide_emitters")

NO_ROULETTE = 1000  # a roulette depth that no path reaches


def path_options(integrator: Any) -> dict[str, Any]:
    """max_depth, rr_depth and hide_emitters of an instantiated integrator, as far as it tells.

    Mitsuba's C++ integrators expose their depths only in their description string.
    """
    text = str(integrator)
    integrator = getattr(integrator, "options", integrator)    # ours keep them in one record
    options: dict[str, Any] = {"hide_emitters": bool(getattr(integrator, "hide_emitters", False))}
    for key in ("max_depth", "rr_depth"):
        value = getattr(integrator, key, None)
        if value is None:
            match = re.search(rf"\b{key}\s*=\s*(-?\d+)", text)
            value = int(match.group(1)) if match else None
        if value is not None:
            # an unlimited depth is stored as the largest unsigned number
            options[key] = -1 if int(value) >= 2**31 - 1 else int(value)
    if text.startswith("DirectIntegrator"):
        options["max_depth"] = 2
    return options


def integrator_spec(scene: Any, integrator: Mapping[str, Any] | str | None = None,
                    **overrides: Any) -> dict[str, Any]:
    """The properties of the integrator to differentiate with.

    `integrator` may be a dict of properties, a plugin name, or None for `DEFAULT_INTEGRATOR`. Path options
    it leaves open are taken from the scene's own integrator; `overrides` that are not None win over both.
    """
    if isinstance(integrator, Mapping):
        spec = dict(integrator)
    else:
        spec = {"type": integrator or DEFAULT_INTEGRATOR}
    own = path_options(scene.integrator()) if scene.integrator() is not None else {}
    for key, value in own.items():
        spec.setdefault(key, value)
    spec.update({k: v for k, v in overrides.items() if v is not None})
    return spec


def term_table(plugin: str) -> tuple[tuple[str, str], ...]:
    """(term, property with its sample budget, 0 for off) of each term of `plugin`; empty: not separable."""
    if plugin in OURS:
        return tuple((term.name, term.budget) for term in TERMS)
    return PROJECTIVE_TERMS if plugin in ("prb_projective", "direct_projective") else ()


def terms_of(spec: Mapping[str, Any]) -> list[str]:
    """Names of the terms that `spec` renders; empty when its terms cannot be separated."""
    return [name for name, budget in term_table(spec["type"]) if _budget(spec, budget) != 0]


def _budget(spec: Mapping[str, Any], budget: str) -> int:
    """A term's own samples, or those of the budget that it follows, as in `Options.budget`."""
    return spec.get(budget, spec.get(FOLLOWS.get(budget, budget), 1))


def build(spec: Mapping[str, Any]) -> Any:
    """Instantiate `spec`; an unknown plugin or property becomes an `OptionError`. `plan` may be a `Plan`."""
    given = {key: value.to_json() if isinstance(value, Plan) else value for key, value in spec.items()}
    try:
        return mi.load_dict(given)
    except RuntimeError as error:
        if UNKNOWN.format(spec.get("type")) in str(error):
            raise OptionError(f"there is no integrator '{spec.get('type')}': ours are {' and '.join(OURS)}, "
                              "Mitsuba has others, such as prb") from error  # fmt: skip
        raise OptionError(f"integrator '{spec.get('type')}' cannot be made: {_last_line(error)}") from error


def build_term(spec: Mapping[str, Any], term: str) -> Any:
    """The integrator that renders `term` alone: every other budget is 0."""
    table = term_table(spec["type"])
    # its own budget is named, so that it does not follow one that is switched off; runtime spp decides anyway
    budgets = {budget: _budget(spec, budget) if name == term else 0 for name, budget in table}
    return build({**spec, **budgets})


def reference(spec: Mapping[str, Any], scene: Any) -> Any:
    """What finite differences are taken of: Mitsuba's `path`, or what `image_plugin` says, with the options of `spec`.

    `psdr_bdpt` where it shows what `path` does not, light of points by way of mirrors and smooth glass, or hardly ever
    finds, that by way of rough ones. With `aovs`, Mitsuba's `aov` around it.
    """
    if spec.get("aovs"):
        inner = {key: value for key, value in spec.items() if key != "aovs"}
        return build({"type": "aov", "aovs": Aovs.parse(spec["aovs"]).text, "image": reference(inner, scene)})
    options = {k: spec[k] for k in PATH_OPTIONS if k in spec}
    if spec.get("type") == "psdr_bdpt" and spec.get("light_paths") != "off":
        facts = analyse(scene)
        if facts.has_delta_emitters and focusing_shapes(scene, facts):
            return build({"type": "psdr_bdpt", **options})
    return build({"type": image_plugin(scene, bool(options.get("hide_emitters", False))), **options})


def draws_itself(integrator: Any) -> bool:
    """Does it draw its random numbers itself, whatever sampler the sensor has? Mitsuba's scalar variants go through
    Python for every ray if asked for another sampler, so they count as well.
    """
    return mi.variant().startswith("scalar") or hasattr(integrator, "options")


def rejected(integrator: Any) -> int | None:
    """Samples dropped as not finite so far, if the integrator counts them (`stats.rejected`)."""
    stats = getattr(integrator, "stats", None)
    count = stats.get("rejected") if isinstance(stats, Mapping) else getattr(stats, "rejected", None)
    if count is None:
        return None
    return int(np.sum(np.array(count))) if dr.is_array_v(count) else int(count)


def to_image(tensor: Any) -> np.ndarray:
    """A rendered tensor as a float64 array (H, W, C)."""
    image = np.array(tensor, dtype=np.float64)
    return image if image.ndim == 3 else image[..., None]


def aovs_of(integrator: Any) -> list[str]:
    """Names of the channels that one of our integrators renders behind those of the film, as `dd.T`."""
    own = getattr(integrator, "aovs", None)
    return own.aovs.channels if isinstance(own, AovChannels) else []


def names_of_aovs(scene: Any, sensor: int, channels: int) -> list[str]:
    """Names of the last of so many channels that Mitsuba's own `aov` has rendered; none where they do not add up.

    It lists the four channels of the integrator inside as well, which are those of the film.
    """
    named = list(scene.integrator().aov_names())
    if len(named) == channels:  # nothing inside
        return named
    own = channels - black(scene.sensors()[sensor].film()).shape[-1]
    return named[len(named) - own :] if 0 < own == len(named) - INSIDE else []


def _last_line(error: Exception) -> str:
    """The cause, which Mitsuba puts last; of unknown properties their names."""
    unknown = re.findall(r'^\s*- \S+ "(\w+)":', str(error), re.MULTILINE)
    if unknown:
        return f"it has no property {', '.join(map(repr, unknown))}"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else str(error)
