"""Images as few bytes: whole numbers on a scale of chosen precision, predicted, split into bytes, compressed.

Values are x = s sinh(q Δ), q whole: relative steps Δ far from 0, absolute steps s Δ near it, so that small values of
either sign are kept as long as they can be told from 0 in a picture. Standard errors, themselves known to some per cent
only, have longer steps. A layer that is the sum of others is stored as what is left after subtracting the sum of those
*as stored*, in steps of 4 s Δ.

Channels may be stored as differences to the second one, rows as differences to the value on the left, whichever has
the lower entropy. `page/decode.js` does the inverse.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from psdr_jit.derivative.images import robust_limit

FLOOR = 1 / 64     # s, of the end of the colour scale: the resolution of the eye there
RESIDUAL_STEP = 4    # step of what is left of a sum [s Δ]


@dataclass(frozen=True)
class Precision:
    """Δ of values and of standard errors: they are right to Δ / 2 of themselves."""

    value: float
    stderr: float


#: From what no reader tells from the original to what still shows it, for images with much noise.
LADDER = tuple(
    Precision(2.0**-bits, stderr)
    for bits, stderr in ((14, 0.01), (12, 0.02), (10, 0.05), (9, 0.07), (8, 0.1), (7.5, 0.12), (7, 0.15), (6.5, 0.17),
                         (6, 0.2), (5.5, 0.25), (5, 0.3), (4.5, 0.4), (4, 0.5))
)  # fmt: skip


class Stream:
    """Collects encoded images; `bytes()` compresses all of them together."""

    def __init__(self, precision: Precision) -> None:
        self.precision = precision
        self._parts: list[bytes] = []

    def value(self, image: np.ndarray, step: float) -> tuple[dict[str, Any], np.ndarray]:
        """How to decode an image (H, W, C) that is stored in steps Δ, and what decoding it will yield."""
        floor = FLOOR * robust_limit([image])
        q = _rounded(np.arcsinh(image / floor) / step)
        how = {"scale": "sinh", "floor": floor, "step": step, **self._integers(q, ~np.isfinite(image))}
        return how, floor * np.sinh(np.nan_to_num(q, posinf=0, neginf=0) * step)

    def residual(self, image: np.ndarray, stored: np.ndarray, of: Sequence[str]) -> dict[str, Any]:
        """How to decode an image that is the sum of layers `of`, which decode to `stored` together."""
        step = RESIDUAL_STEP * self.precision.value * FLOOR * robust_limit([image])
        q = _rounded((image - stored) / step)
        return {"scale": "sum", "of": list(of), "step": step, **self._integers(q, ~np.isfinite(image))}

    def bytes(self) -> bytes:
        return zlib.compress(b"".join(self._parts), 9)

    def _integers(self, q: np.ndarray, unknown: np.ndarray) -> dict[str, Any]:
        """Append whole numbers (H, W, C); `unknown` ones get a number that no other has."""
        q = np.nan_to_num(q, posinf=0, neginf=0).astype(np.int64)
        nan = None
        if unknown.any():
            nan = int(np.abs(q[~unknown]).max(initial=0)) + 1
            q = np.where(unknown, nan, q)
        apart = [q[..., k] for k in range(q.shape[-1])]
        against = [c if k == 1 else c - apart[1] for k, c in enumerate(apart)] if len(apart) == 3 else apart
        plain, mixed = _predicted(apart), _predicted(against)
        together = sum(e for _, _, e in mixed) < sum(e for _, _, e in plain)
        chosen = mixed if together else plain
        codes = [_unsigned(plane) for plane, _, _ in chosen]
        count = max(1, -(-int(max(c.max(initial=0) for c in codes)).bit_length() // 8))
        for code in codes:
            for byte in range(count):
                self._parts.append(((code >> (8 * byte)) & 255).astype(np.uint8).tobytes())
        return {"channels": len(apart), "bytes": count, "mixed": together, "left": [left for _, left, _ in chosen],
                "nan": nan}  # fmt: skip


def _rounded(values: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.round(values)


def _predicted(planes: Sequence[np.ndarray]) -> list[tuple[np.ndarray, bool, float]]:
    """(plane, whether by differences to the left, its entropy in bits) for each plane."""
    found = []
    for plane in planes:
        steps = np.diff(plane, axis=1, prepend=0)
        costs = _entropy(plane), _entropy(steps)
        left = costs[1] < costs[0]
        found.append((steps if left else plane, left, costs[left]))
    return found


def _entropy(plane: np.ndarray) -> float:
    """Bits per pixel of the numbers on their own."""
    numbers = (plane - plane.min()).ravel()
    counts = np.bincount(numbers) if numbers.max() < numbers.size else np.unique(numbers, return_counts=True)[1]
    share = counts[counts > 0] / plane.size
    return float(-(share * np.log2(share)).sum())


def _unsigned(plane: np.ndarray) -> np.ndarray:
    """0, −1, 1, −2, 2, ... as 0, 1, 2, 3, 4, ..."""
    return np.where(plane < 0, -2 * plane - 1, 2 * plane)
