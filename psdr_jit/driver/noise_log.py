"""What is known of the noise of a kind of call, from its pilot and from the derivative images since.

Images of successive calls in forward mode are independent samples of (nearly) the same derivative: half the square of
their difference estimates the variance of either. Budgets follow from earlier calls only, so that every estimate stays
unbiased, and change at call numbers that are powers of two only, so that a forward and a backward call in between draw
the same samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from ..core.line_guide import LineTally
from .film_noise import FORGET, coarse
from .pilot import REFRESH, Measurement, variance_of_pair

#: Pairs of images that are looked at in a row, and from then on one in so many calls.
EAGER, SELDOM = 8, 16

#: What lines have brought before a guide was made counts for this share of itself in the next one.
FADED = 0.5


@dataclass
class NoiseLog:
    """Of one kind of call: same parameters, sensor, options."""

    calls: int = 0
    measured: Measurement | None = None  # by the pilot
    current: Measurement | None = None  # with what was observed since
    share: tuple | None = None  # `(spp by term, form, reason)` that followed from `current` when it was last due
    pairs: int = 0  # of images that were compared since the last pilot
    weighed: dict[tuple[str, str], int] = field(default_factory=dict)  # observations that count, by (form, term)
    last: dict[str, tuple[int, int, str, mi.TensorXf]] = field(default_factory=dict)  # term: (seed, paths, form, image)
    pending: list[tuple[str, str, int, mi.TensorXf]] = field(default_factory=list)  # (form, term, paths, variance)

    @property
    def needs_pilot(self) -> bool:
        return self.calls % REFRESH == 0

    @property
    def epoch(self) -> int:
        """Number of the pilot."""
        return self.calls // REFRESH

    @property
    def guides_due(self) -> bool:
        """Is this a call at which guides may change? A power of four: there has to be much more to go by."""
        return self.calls > 1 and self.calls & (self.calls - 1) == 0 and self.calls.bit_length() % 2 == 1

    def heard(self, form: str, name: str) -> LineTally | None:
        """What the lines of a term have brought up to now, to which this call may add."""
        noise = None if self.current is None else self.current.noise.get(form, {}).get(name)
        return None if noise is None else noise.heard

    @property
    def due(self) -> bool:
        """Is this a call at which budgets may change?"""
        return self.needs_pilot or self.calls & (self.calls - 1) == 0

    def pilot(self, measured: Measurement) -> None:
        """Start again from a new pilot."""
        self.measured = self.current = measured
        self.pairs = 0
        self.weighed.clear()

    def observe(self, form: str, seed: object, paths: Mapping[str, int], images: Mapping[str, mi.TensorXf]) -> None:
        """Compare the images of this call with those of the last one, if their seeds differ."""
        if not isinstance(seed, int) or not (self.pairs < EAGER or self.calls % SELDOM < 2):
            self.last.clear()
            return
        compared = False
        for name, image in images.items():
            before = self.last.get(name)
            if before is not None and before[0] != seed and before[1:3] == (paths[name], form):
                self.pending.append((form, name, paths[name], variance_of_pair(image, before[3])))
                compared = True
            self.last[name] = (seed, paths[name], form, image)
        self.pairs += compared

    def learn(self) -> None:
        """Let what was observed count."""
        if self.current is None:
            return
        over_film: dict[tuple[str, str, int], list[np.ndarray]] = {}
        for form, name, n, pixels in self.pending:
            if name not in self.current.noise[form]:
                continue
            variance = coarse(np.array(pixels, np.float64))
            over_film.setdefault((form, name, n), []).append(variance)
            count = self.weighed[form, name] = self.weighed.get((form, name), 0) + 1
            self.current = self.current.observed(form, name, float(variance.mean()), n, max(FORGET, 1 / count))
        for (form, name, n), seen in over_film.items():
            self.current = self.current.seen_on_film(form, name, sum(seen) / len(seen), n, len(seen))
        self.pending.clear()
        if self.guides_due and self.share is not None:
            self.current = self.current.guided(self.share[1][0], FADED)
