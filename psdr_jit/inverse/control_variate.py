"""Images with less noise than their samples give: what earlier iterations know of them is carried along.

An optimisation renders almost the same image again and again. Let A_n be a render of the image I(θ_n) with the seed
s_n, and B_n another one, also of I(θ_n), with the seed s_{n+1} of the next iteration. B_{n−1} and A_n then come from
the same random numbers, before and after a step, and the loss is evaluated at

    Î_n = A_n + α_n R_n,    R_n = Î_{n−1} − B_{n−1},    Î_0 = A_0                                               (1)

[Nicolet, Rousselle, Novák, Keller, Jakob, Müller 2023, "Recursive Control Variates for Inverse Rendering", ACM TOG
42(4)]. Both images in R_n are of I(θ_{n−1}), so E R_n = 0 and E Î_n = I(θ_n), for parameters and α that do not depend
on the samples. It costs one more image per iteration, and no way back to the parameters before the step.

The variance of (1) is least where α_n = Cov(A_n, B_{n−1}) / (Var B_{n−1} + Var Î_{n−1}). As A_n is the only one of
A_n, B_n that shares samples with R_n, both follow from sums over the pixels ⟨·⟩ of differences whose mean is 0:

    α_n = ⟨(B_m − A_m) R_m⟩ / ⟨R_m²⟩,    averaged over earlier iterations m < n                                    (2)

One α for each view and channel: finer ones, by tile or by pixel, had as much variance or more on the examples.

Bias: α_n shares samples with R_n, but is one number out of all pixels; this is of the order of 1 / pixels. And θ_n is
where errors of Î_{n−1} have led, of which a part is still in Î_n: given the parameters, the image lags behind their
latest movement. On `shadow` by a tenth of what five steps moved (0.10 ± 0.04 and 0.11 ± 0.04, two runs, iterations 90
to 150, α = 0.7); single images do not.

What it is good for: a single step is less noisy, the mean of many is not, as the same random numbers are in it: errors
last for some 1 / (1 − α) iterations. Runs that noise holds up get on faster; they do not end nearer to the truth than
with as many independent samples, see `scenes/inverse/README.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import mitsuba as mi
import numpy as np

from psdr_jit.core.upload import uploaded

#: Weight of the latest pair of images in the averages of (2): they follow the size of the steps within ten iterations.
FORGET = 0.1

#: Of α. What is carried along fades within some twenty iterations; at best, a 40th of the variance is left.
LARGEST = 0.95

Key = tuple[int, int]  # number of the view, and which of its independent images
Seeds = Callable[[int, int, int], int]  # of a render: by iteration, view and image


@dataclass(frozen=True)
class Chain:
    """What is known of one image after an iteration, (H, W, C) float32, and the averages of (2), (C,)."""

    image: np.ndarray  # Î_n
    control: np.ndarray  # B_n
    cross: np.ndarray  # ⟨(B − A) R⟩
    square: np.ndarray  # ⟨R²⟩
    count: np.ndarray  # (), iterations that the image was seen in

    @property
    def alpha(self) -> np.ndarray:
        """(2), by channel; 0 before anything is known."""
        known = self.square > 0
        return np.clip(np.where(known, self.cross / np.where(known, self.square, 1), 0), 0, LARGEST)


def begun(own: np.ndarray, control: np.ndarray) -> Chain:
    """After the first iteration: A_0, B_0."""
    nothing = np.zeros(own.shape[-1])
    return Chain(own, control, nothing, nothing, np.array(1))


def followed(chain: Chain, own: np.ndarray, control: np.ndarray) -> Chain:
    """After one more, which rendered A_n = `own` with the seed of `chain.control`, and B_n = `control`."""
    rest = chain.image.astype(np.float64) - chain.control
    pixels = tuple(range(rest.ndim - 1))
    cross, square = ((control - own) * rest).mean(pixels), np.square(rest).mean(pixels)
    weight = max(FORGET, 1 / float(chain.count))
    return Chain((own + chain.alpha * rest).astype(np.float32), control,
                 chain.cross + weight * (cross - chain.cross), chain.square + weight * (square - chain.square),
                 chain.count + 1)  # fmt: skip


class Single:
    """Every image by itself, as it is rendered."""

    def seeds(self, seed: Seeds, iteration: int, key: Key) -> Sequence[int]:
        """Of the images that must be rendered for one that the loss sees."""
        return (seed(iteration, *key),)

    def estimate(self, key: Key, images: Sequence[mi.TensorXf]) -> mi.TensorXf:
        """What the loss sees, of the renders with those seeds."""
        return images[0]

    def settle(self) -> None:
        """The iteration is done, and will not be repeated."""

    def arrays(self) -> dict[str, np.ndarray]:
        """All that is carried along, for a checkpoint."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """What `arrays` returned."""


class Recursive(Single):
    """By (1): a chain for every image of every view, which is at rest while other views are seen."""

    def __init__(self) -> None:
        self._chains: dict[Key, Chain] = {}
        self._next: dict[Key, Chain] = {}  # of an iteration that may yet have to be repeated

    def seeds(self, seed: Seeds, iteration: int, key: Key) -> Sequence[int]:
        seen = int(self._chains[key].count) if key in self._chains else 0
        return seed(seen, *key), seed(seen + 1, *key)

    def estimate(self, key: Key, images: Sequence[mi.TensorXf]) -> mi.TensorXf:
        own, control = (np.array(image, dtype=np.float32) for image in images)
        chain = self._chains.get(key)
        found = self._next[key] = begun(own, control) if chain is None else followed(chain, own, control)
        return mi.TensorXf(uploaded(mi.Float, found.image), found.image.shape)

    def settle(self) -> None:
        self._chains |= self._next
        self._next = {}

    def arrays(self) -> dict[str, np.ndarray]:
        return {f"{view}/{image}/{f.name}": np.array(getattr(chain, f.name))
                for (view, image), chain in self._chains.items() for f in fields(Chain)}  # fmt: skip

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        found: dict[Key, dict[str, Any]] = {}
        for name, value in arrays.items():
            view, image, what = name.split("/")
            found.setdefault((int(view), int(image)), {})[what] = value
        self._chains = {key: Chain(**values) for key, values in found.items()}
        self._next = {}


def estimates_of(control_variate: bool) -> Single:
    """How a run finds the images that its loss sees."""
    return Recursive() if control_variate else Single()
