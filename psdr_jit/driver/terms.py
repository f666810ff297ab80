"""The table of derivative terms that an integrator sums, and the job description each of them receives.

Adding a term: one module with `forward(job)` and `backward(job, grad_in)`, one row here, one budget in `options.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi

from ..boundary import direct, indirect, primary
from ..interior import term as interior_term
from ..plan.job import Job


@dataclass(frozen=True)
class Term:
    """A summand of the derivative image. `budget` names the option that holds its samples per pixel."""

    name: str
    budget: str
    forward: Callable[[Job], mi.TensorXf]
    backward: Callable[[Job, mi.TensorXf], None]
    weights: Callable[[Job], mi.Float | None] | None = None  # of the edges it samples, by row of the edge table


TERMS = (
    Term("interior", "sppc", interior_term.forward, interior_term.backward),
    Term("primary", "sppp", primary.forward, primary.backward, primary.edge_weights),
    Term("direct", "sppd", direct.forward, direct.backward, direct.edge_weights),
    Term("indirect", "sppi", indirect.forward, indirect.backward, indirect.edge_weights),
)
