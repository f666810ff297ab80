"""Who looks at an optimisation while it runs, and what there is to see.

An observer is an object with the methods of `Observer`. It may look at the scene, which stands where the images of the
iteration were taken; it must not change it. `live_view` and `event_files` are observers.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from psdr_jit.inverse.variables import numbers

#: Images and meshes that are kept of a run, at most: those of so many iterations, evenly spread.
FRAMES = 200

#: Numbers of a latent up to which each has a curve of its own.
FEW = 16


@dataclass(frozen=True)
class Seen:
    """What an iteration has found, before its step."""

    iteration: int
    loss: float
    rate: float  # factor of the learning rates
    norms: dict[str, float]  # of the gradient, by latent
    offsets: dict[str, dict[str, float]]  # from the scene's own values, by variable
    latents: dict[str, dict[str, Any]]  # detached
    images: dict[int, np.ndarray]  # by view, (H, W, C)


class Observer(Protocol):
    """Protocol of what may look."""

    def begin(self, problem: Any) -> None:
        """Once, before the first iteration; the scene stands where the run starts."""

    def step(self, seen: Seen) -> None:
        """After each iteration; the scene stands where it was in it."""

    def close(self, iteration: int) -> None:
        """Once, whatever has happened. After so many iterations the scene is left as it now stands."""


def curves(seen: Seen) -> dict[str, list[float]]:
    """What is drawn over the iterations, by name: one number, or a few that belong together."""
    found = {"loss": [seen.loss], "learning_rate": [seen.rate]}
    found |= {f"gradient_norm/{name}": [norm] for name, norm in seen.norms.items()}
    for name, offsets in seen.offsets.items():
        found |= {f"offset/{name}/{kind}": [value] for kind, value in offsets.items()}
    for name, latents in seen.latents.items():
        values = {latent: numbers(value) for latent, value in latents.items()}
        found |= {f"value/{name}/{latent}": list(v) for latent, v in values.items() if 0 < v.size <= FEW}
    return {name: values for name, values in found.items() if np.all(np.isfinite(values))}


def frame_due(iteration: int, iterations: int) -> bool:
    """Are images and meshes of this iteration kept?"""
    return iteration % max(1, -(-iterations // FRAMES)) == 0


class Care:
    """Lets a run go on when what shows it fails: a full disk, a viewer that was closed. Said once."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.failed = False

    def attempt(self, write: Callable[[], Any]) -> None:
        if self.failed:
            return
        try:
            write()
        except (OSError, RuntimeError) as error:  # RuntimeError: Rerun says all its troubles so
            self.failed = True
            warnings.warn(f"{self.what} has ended: {error}; the optimisation goes on", RuntimeWarning, stacklevel=4)
