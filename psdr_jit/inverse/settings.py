"""How an optimisation runs: numbers and names only."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drjit import opt

from psdr_jit.errors import OptionError

PLUGINS = {"adam": opt.Adam, "adamw": opt.AdamW, "sgd": opt.SGD, "rmsprop": opt.RMSProp}  # those of mi.ad


@dataclass(frozen=True)
class Settings:
    """Of a run. Samples are per pixel; `None` stands for "no limit"."""

    iterations: int = 100
    spp: int = 16  # of the image that the loss sees
    gradient_spp: int = 0  # of the derivative; 0: as many
    control_variate: bool = False  # images carry along what earlier iterations know, see `inverse.control_variate`
    views_per_step: int = 0  # views that are rendered per iteration; 0: all
    seed: int = 0
    decay: float = 1.0  # of the learning rates, from the first to the last iteration, geometrically
    optimizer: Mapping[str, Any] = field(default_factory=lambda: {"type": "adam"})
    checkpoint_every: int = 10  # iterations
    snapshot_every: int = 50  # iterations; 0: none
    max_seconds: float | None = None
    perturb: int | None = None  # seed of a random displacement of the start
    stalled_after: int = 5  # iterations without a gradient before a warning
    diverged_factor: float = 10.0  # the run ends if the mean recent loss exceeds the first ones so many times

    def __post_init__(self) -> None:
        least = {"iterations": 1, "spp": 1, "gradient_spp": 0, "views_per_step": 0, "seed": 0, "checkpoint_every": 1,
                 "snapshot_every": 0, "stalled_after": 1}  # fmt: skip
        given = {name: getattr(self, name) for name in least}
        bad = [name for name, value in given.items() if not _is_whole(value) or value < least[name]]
        wrong = [f"{name} = {given[name]!r}: expected a whole number from {least[name]} on" for name in bad]
        if not isinstance(self.control_variate, bool):
            wrong.append(f"control_variate = {self.control_variate!r}: expected true or false")
        if self.perturb is not None and not (_is_whole(self.perturb) and self.perturb >= 0):
            wrong.append(f"perturb = {self.perturb!r}: expected a whole number from 0 on")
        if not (is_number(self.decay) and 0 < self.decay <= 1):
            wrong.append(f"decay = {self.decay!r}: expected a number above 0, at most 1")
        if not (is_number(self.diverged_factor) and self.diverged_factor > 1):
            wrong.append(f"diverged_factor = {self.diverged_factor!r}: expected a number above 1")
        if self.max_seconds is not None and not (is_number(self.max_seconds) and self.max_seconds > 0):
            wrong.append(f"max_seconds = {self.max_seconds!r}: expected a number above 0")
        if not isinstance(self.optimizer, Mapping) or self.optimizer.get("type") not in PLUGINS:
            wrong.append(f"optimizer = {self.optimizer!r}: its type must be one of {', '.join(PLUGINS)}")
        else:
            known = set(inspect.signature(PLUGINS[self.optimizer["type"]].__init__).parameters) - {
                "self",
                "lr",
                "params",
            }
            unknown = sorted(set(self.optimizer) - known - {"type"})
            if unknown:
                wrong.append(
                    f"optimizer '{self.optimizer['type']}' has no option {', '.join(map(repr, unknown))}: it has "
                    f"{', '.join(sorted(known))}"
                )
        if wrong:
            raise OptionError("; ".join(wrong))

    def make_optimizer(self, uniform: bool) -> Any:
        """One of Mitsuba's optimisers, with learning rates to be set. Raises `OptionError` for unknown options."""
        options = {key: value for key, value in self.optimizer.items() if key != "type"}
        kind = self.optimizer["type"]
        if kind in ("adam", "adamw"):
            options.setdefault("uniform", uniform)
        try:
            return PLUGINS[kind](lr=1.0, **options)
        except (TypeError, RuntimeError) as error:
            raise OptionError(f"optimizer '{kind}': {error}") from error


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whole or not, but not a truth value."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
