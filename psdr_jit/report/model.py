"""What a page shows, as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

RADIANCE, SIGNED = "radiance", "signed"  # shown with the curve of a display, or in two colours about 0


@dataclass(frozen=True)
class Layer:
    """One image (H, W, C) of finite numbers or NaN, its standard error if known, and how it is to be shown.

    `sum_of`: layers that it is the sum of, but for rounding. `difference_of`: two layers that it is computed from in
    the page; `image` is then None.
    """

    name: str
    role: str  # RADIANCE or SIGNED
    image: np.ndarray | None
    stderr: np.ndarray | None = None
    sum_of: Sequence[str] = ()
    difference_of: Sequence[str] = ()


@dataclass(frozen=True)
class View:
    """What one sensor sees: layers of one size."""

    name: str
    layers: Sequence[Layer]
    unit: str  # of signed layers


@dataclass(frozen=True)
class Curve:
    """Numbers over iterations; None where one was not finite."""

    name: str
    unit: str
    values: Sequence[float | None]
    group: str = ""  # curves of one group share a chart


@dataclass(frozen=True)
class Report:
    """A page."""

    title: str
    about: str
    facts: Sequence[tuple[str, str]]
    views: Sequence[View]
    iterations: Sequence[int] = ()
    curves: Sequence[Curve] = field(default=())
