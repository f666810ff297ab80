"""What a suite is: a module with `NAME` and the functions below. `run.py` knows no more about one.

    BUDGET                                       seconds of rendering that a method gets per case, unless told
    case_names() -> list[str]                    quick_case_names() -> list[str]
    method_names(case) -> list[str]              in the order in which they run
    open_case(case, settings) -> opened          once per process
    measure(opened, method) -> row               without circumstances; `status` is "ok" or "cannot" with an `error`
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REFERENCE = "reference"  # the method that others are compared with: it runs first, and always
SUITES = ("accuracy", "stability", "cost", "planning")
ON_REQUEST = ("inverse",)  # not part of a full run


@dataclass(frozen=True)
class Settings:
    """Of a run: where rows and images go, and the seconds of rendering that a method gets per case."""

    folder: Path
    budget: float
    variant: str


def suite(name: str) -> Any:
    """The module of a suite."""
    return importlib.import_module(f"benchmarks.{name}")
