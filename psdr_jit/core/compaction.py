"""Keeping the lanes that matter."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

T = TypeVar("T")


def compact(record: T, active: mi.Bool) -> T | None:
    """The lanes of `record` (a dataclass of arrays) that are active; None if there are none. Evaluated.

    All fields in one kernel, before and after: a gather from pending arrays would launch one for each.
    """
    dr.eval(record, active)
    kept = dr.compress(active)
    if dr.width(kept) == 0:
        return None
    found = dr.gather(type(record), record, kept)
    dr.eval(found)
    return found
