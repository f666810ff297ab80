"""Keeping the lanes that matter."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

T = TypeVar("T")


def compact(record: T, active: mi.Bool) -> T | None:
    """The lanes of `record` (a dataclass of arrays) that are active; None if there are none. Evaluates.

    All fields are evaluated in one kernel first: a gather from pending arrays would launch one for each.
    """
    dr.eval(record, active)
    kept = dr.compress(active)
    return dr.gather(type(record), record, kept) if dr.width(kept) > 0 else None
