"""Which receivers of boundary segments have another surface close by: what the mixed form tells its two kinds apart by.

At these the indirect boundary is that of the spatial form, at all others that of the material form
(`interior/material.py`). Each is sampled by itself, and counts at its own receivers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mitsuba as mi

from ..core.compaction import compact
from ..plan.job import Job
from .edge_lines import EdgeView
from .segment_motion import SecondaryTerm


def close_by(job: Job, view: EdgeView) -> mi.Bool:
    """Does anything lie close by x_D, on the side of the edge? Lanes."""
    hit = view.receiver
    ray = mi.Ray3f(hit.o, hit.d, 0, view.wavelengths)
    return job.close_by.met_by(ray, hit.intersection(), -hit.d)


def at_close_receivers(part: SecondaryTerm) -> SecondaryTerm:
    """A part in spatial form, which traces `EdgeView`, of receivers with something close by."""
    return _narrowed(part, close_by)


def at_open_receivers(part: SecondaryTerm) -> SecondaryTerm:
    """A part in material form, which traces `Background`, of all others."""
    return _narrowed(part, lambda job, background: ~close_by(job, background.view))


def _narrowed(part: SecondaryTerm, keeps: Callable[[Job, Any], mi.Bool]) -> SecondaryTerm:
    """The part, of those traced that it `keeps`."""

    def trace(job: Job, edges, line):
        found = part.trace(job, edges, line)
        return None if found is None else compact(found, keeps(job, found))

    return replace(part, trace=trace)
