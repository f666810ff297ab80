"""One thing that is driven through values, step by step; each step is a case of a suite."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Sweep:
    """`step(value)` is what is measured at that value; `unit` is for the axis of a chart."""

    name: str
    unit: str
    values: Sequence[float]
    step: Callable[[float], Any]
    one_truth: Any = None  # every step has the derivative of this case
    largest_step: Callable[[float], float] | None = None  # of differences, where the default is coarse [scene units]


def case_name(sweep: Sweep, value: float) -> str:
    return f"{sweep.name} {value:g}"


def case_names(sweeps: Sequence[Sweep]) -> list[str]:
    return [case_name(sweep, value) for sweep in sweeps for value in sweep.values]


def quick_case_names(sweeps: Sequence[Sweep], names: Sequence[str], stride: int) -> list[str]:
    """Every `stride`th step of the sweeps with these names."""
    chosen = [sweep for sweep in sweeps if sweep.name in names]
    return [case_name(sweep, value) for sweep in chosen for value in sweep.values[::stride]]


def find(sweeps: Sequence[Sweep], name: str) -> tuple[Sweep, float]:
    """Sweep and value of a case."""
    return next((s, v) for s in sweeps for v in s.values if case_name(s, v) == name)
