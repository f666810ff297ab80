"""The losses of a run: do they diverge, and which state was the best?

The loss of a few views says little about another few, so losses are averaged over whole rounds of views.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

#: Losses that are averaged at least, because one alone may be noise.
RECENT = 5

#: Iterations in a row that the losses must have been above the first ones, all of them: noise does not do that.
LONG = 50

#: Share of the first losses that the best must have been below, for a return to them to count as a loss of what was
#: found.
FOUND = 0.1


class History:
    """Of one run. `period`: iterations in which every view is seen; `signed`: losses may be negative by noise."""

    def __init__(self, period: int, signed: bool, start: Any) -> None:
        self.period, self.signed = period, signed
        self.window = period * math.ceil(RECENT / period)
        self.first: list[float] = []  # losses of the first window
        self.recent: deque[float] = deque(maxlen=self.window)
        self._states: deque[tuple[float, Any]] = deque(maxlen=self.window)
        self.best, self.best_loss = start, math.inf  # mean over a window
        self.count = 0
        self.above = 0  # losses in a row above all of the first window

    def add(self, loss: float, state: Any) -> None:
        """A loss, and the state that it was found at."""
        self.count += 1
        self.recent.append(loss)
        self._states.append((loss, state))
        if len(self.first) < self.window:
            self.first.append(loss)
        self.above = self.above + 1 if loss > max(self.first) else 0
        mean = float(np.mean(self.recent))
        if len(self.recent) == self.window and mean < self.best_loss:
            # of one view alone the loss does not tell; then the oldest, before whatever came after it
            self.best = self._states[0][1] if self.period > 1 else min(self._states, key=lambda entry: entry[0])[1]
            self.best_loss = mean

    @property
    def mean(self) -> float:
        """Of the recent losses; NaN before the first."""
        return float(np.mean(self.recent)) if self.recent else math.nan

    @property
    def scale(self) -> float:
        """What losses were like at first. Of losses that noise can make negative, the largest size counts."""
        sizes = np.abs(self.first)
        return float(sizes.max()) if self.signed else float(sizes[: self.period].mean())

    def diverges(self, factor: float) -> bool:
        """Is a whole window of losses that much above the first ones, or the latest not finite?"""
        if self.recent and not math.isfinite(self.recent[-1]):
            return True
        return self.count >= 2 * self.window and len(self.recent) == self.window and self.mean > factor * self.scale

    @property
    def regressed(self) -> bool:
        """Was the best loss long ago and far below the first ones, and all since then above them?"""
        found = self.best_loss < FOUND * self.scale
        return not self.signed and found and self.above >= max(LONG, self.window)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything but the states, for a checkpoint."""
        return {"first": np.array(self.first), "recent": np.array(self.recent),
                "best_loss": np.array(self.best_loss), "count": np.array(self.count),
                "above": np.array(self.above)}  # fmt: skip

    def restore(self, arrays: Mapping[str, np.ndarray], best: Any) -> None:
        """What `arrays` returned, and the best state."""
        self.first = arrays["first"].tolist()
        self.recent = deque(arrays["recent"].tolist(), maxlen=self.window)
        self.best, self.best_loss, self.count = best, float(arrays["best_loss"]), int(arrays["count"])
        self.above = int(arrays.get("above", 0))
        self._states = deque([(loss, best) for loss in self.recent], maxlen=self.window)
