"""The random numbers that choose lines through edges, as the job's guide prefers them (`core/line_guide.py`)."""

from __future__ import annotations

import mitsuba as mi

from ..core.line_guide import NO_PREFERENCE, Drawn, GuideTables, LineGuide
from ..core.memory import Slot
from ..plan.job import Job
from .distribution import stratified

#: Of one render call: tables of guides.
GUIDES: Slot[dict[LineGuide, GuideTables]] = Slot(dict)


def guided(job: Job, count: int, jitter: mi.Float, u: mi.Point2f) -> tuple[mi.Float64, mi.Point2f, Drawn]:
    """`(x, u, drawn)`: `count` stratified numbers x for edges, u for directions; densities are to be multiplied by
    `drawn.p`.
    """
    guide = job.guide or NO_PREFERENCE  # in the same kernels
    tables = job.shared[GUIDES]
    if guide not in tables:
        tables[guide] = guide.tables()
    return tables[guide].draw(stratified(count, jitter), u)
