"""Random choices that print short: rounded numbers, words, directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class Draw:
    """Draws from one stream of random numbers."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def number(self, low: float, high: float, digits: int = 3) -> float:
        return round(float(self.rng.uniform(low, high)), digits)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def one(self, items: Sequence[Any]) -> Any:
        return items[int(self.rng.integers(len(items)))]

    def weighted(self, weights: Mapping[Any, float]) -> Any:
        words, w = list(weights), np.array(list(weights.values()), dtype=float)
        return words[int(self.rng.choice(len(words), p=w / w.sum()))]

    def unit(self) -> list[float]:
        """A direction, of length 1 up to rounding."""
        v = self.rng.normal(size=3)
        return [round(float(x), 3) for x in v / np.linalg.norm(v)]

    def texels(self, height: int, width: int, low: float, high: float) -> list[list[float]]:
        return np.round(self.rng.uniform(low, high, (height, width)), 2).tolist()
