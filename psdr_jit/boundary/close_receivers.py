"""Which receivers of boundary segments have another surface close by: what the mixed form tells its two kinds apart by.

At these the indirect boundary is that of the spatial form, at all others that of the material form
(`interior/mixed.py`). Each is sampled by itself, and counts at its own receivers.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from ..core.compaction import compact
from ..paths.surface_at import surface_at
from ..plan.job import Job
from .edge_lines import EdgeView
from .indirect_material import Background
from .segment_motion import SecondaryTerm


def close_by(job: Job, view: EdgeView) -> mi.Bool:
    """Does anything lie close by x_D, on the side of the edge? Lanes."""
    hit = view.receiver
    ray = mi.Ray3f(hit.o, hit.d, 0, view.wavelengths)
    si = surface_at(job.surfaces, hit.intersection(), ray, mi.RayFlags.Minimal)
    return job.close_by.has(si, -hit.d, si.is_valid())


def at_close_receivers(part: SecondaryTerm) -> SecondaryTerm:
    """A part in spatial form, of receivers with something close by."""

    def trace(job: Job, edges, line) -> EdgeView | None:
        view = part.trace(job, edges, line)
        return None if view is None else compact(view, close_by(job, view))

    return replace(part, trace=trace)


def at_open_receivers(part: SecondaryTerm) -> SecondaryTerm:
    """A part in material form, of all others."""

    def trace(job: Job, edges, line) -> Background | None:
        found = part.trace(job, edges, line)
        return None if found is None else compact(found, ~close_by(job, found.view))

    return replace(part, trace=trace)
