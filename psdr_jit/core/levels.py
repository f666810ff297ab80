"""Tables of positive weights as short text, which a plan can carry along: their logarithms, a byte each."""

from __future__ import annotations

import base64
import zlib

import numpy as np

#: Resolution, and the level of weight 1.
STEPS_PER_OCTAVE, ZERO_LEVEL = 8, 64


def packed(weights: np.ndarray) -> str:
    """Text of `weights`, relative to their mean, which must be positive."""
    levels = np.round(STEPS_PER_OCTAVE * np.log2(weights / weights.mean())) + ZERO_LEVEL
    return base64.b64encode(zlib.compress(np.clip(levels, 0, 255).astype(np.uint8).tobytes())).decode()


def unpacked(text: str, shape: tuple[int, ...]) -> np.ndarray:
    """The weights, mean 1. Raises ValueError or zlib.error for a text that `packed` has not written for this shape."""
    levels = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(shape)
    weights = 2.0 ** ((levels.astype(float) - ZERO_LEVEL) / STEPS_PER_OCTAVE)
    return weights / weights.mean()
