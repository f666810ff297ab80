"""Which row of the edge table, and where along it: a sampler that can be swapped.

An integrator draws the rows of its boundary terms with `memory[ROW_SAMPLER]`. The default draws them in proportion to
their weights. Another one, a guide, may use what earlier calls have learned, under the conditions that keep estimates
unbiased: `init` is called once in a render call and fixes the state for all its passes, what `learn` is told counts
from the next call on, and `pdf` is positive wherever a weight is. A forward and a backward call draw the same samples
only if nothing is learned in between.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ..core.joining import joined
from ..core.memory import Slot
from ..core.varying import varying
from ..edges.location import EdgeLocation
from ..plan.job import Job
from .distribution import EdgeDistribution, edge_distribution, pmf, sample_edge, stratified

#: Share of the samples on edges of resting shapes while only shapes move.
STATIC_SHARE = 0.25


class RowSampler(ABC):
    """Draws `(row, t)` for one term. States are plain data; what is learned lives in the sampler."""

    @abstractmethod
    def init(self, what: str, weights: list[mi.Float]) -> Any | None:
        """The state of one call for `what` (a term, and what its lines are drawn for): `weights`, by kind of edge, of
        the rows. None if nothing can contribute.
        """

    @abstractmethod
    def sample(self, state: Any, u: mi.Float64) -> tuple[mi.UInt32, mi.Float]:
        """`(row, t)` from u ∈ [0, 1), t ∈ [0, 1); monotonous in u, so that stratification carries over."""

    @abstractmethod
    def pdf(self, state: Any, row: mi.UInt32, t: mi.Float) -> mi.Float:
        """Density of `sample`: probability of the row, times density of t."""

    def learn(self, state: Any, row: mi.UInt32, t: mi.Float, worth: Callable[[], mi.Float]) -> None:
        """What samples of this call were worth, for later calls: contribution per unit of motion over density, computed
        when asked for. One entry per sample.
        """


class WeightedRows(RowSampler):
    """Rows in proportion to their weights, t uniform. Learns nothing."""

    def init(self, what: str, weights: list[mi.Float]) -> EdgeDistribution | None:
        if not weights:
            return None
        distribution = edge_distribution(joined(weights))
        return distribution if float(distribution.total[0]) > 0 else None

    def sample(self, state: EdgeDistribution, u: mi.Float64) -> tuple[mi.UInt32, mi.Float]:
        return sample_edge(state, u)

    def pdf(self, state: EdgeDistribution, row: mi.UInt32, t: mi.Float) -> mi.Float:
        return pmf(state, row)


#: Of one render call: the states by `what` they are for.
STATES: Slot[dict[str, Any]] = Slot(dict)

#: Of an integrator.
ROW_SAMPLER: Slot[RowSampler] = Slot(WeightedRows)

#: What samplers know rows by whose steps are seen from places on the film that move.
FOLLOWED = "followed"


def row_state(job: Job, what: str, weights: Callable[[], list[mi.Float]]) -> Any | None:
    """The sampler's state for `what`, fixed for the render call. None if nothing can contribute."""
    what = f"{what} {FOLLOWED}" if job.facts.places_move else what  # where what rests on the film matters as well
    states = job.shared[STATES]
    if what not in states:
        states[what] = job.call.memory[ROW_SAMPLER].init(what, weights())
    return states[what]


class Table(Protocol):
    """What is known of sampled rows once they have been sampled: as `EdgeTable`."""

    def moves(self, at: EdgeLocation) -> mi.Bool:
        """Can the edges at these locations move?"""

    def displacement(self, at: EdgeLocation, ω: mi.Vector3f) -> mi.Vector3f:
        """Vector of value 0 whose derivative is the velocity of the edges there, seen along ω, attached."""


@dataclass(frozen=True)
class SampledRows:
    """A table, and how its rows are drawn."""

    table: Table
    rows: RowSampler
    state: Any  # of `rows`

    def sample_rows(self, count: int, jitter: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """`(row, t, pdf)` of `count` stratified samples, pdf times their number."""
        return self.rows_at(stratified(count, jitter), count)

    def rests(self, row: mi.UInt32) -> mi.Bool | None:
        """Do these rows matter only through what slides? None: all of them matter by themselves."""
        return None

    def rows_at(self, x: mi.Float64, count: int) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """The same for given numbers in [0, 1)."""
        row, t = self.rows.sample(self.state, x)
        return row, t, self.rows.pdf(self.state, row, t) * varying(mi.Float, count)


def edge_samples(job: Job, paths: int) -> int:
    """Number of edge samples for a term's budget, which counts paths: one edge sample takes `paths` of them."""
    width, height = job.frame.crop_size
    return max(1, job.spp * width * height // paths)


def with_static_share(weights: list[mi.Float], moving: list[mi.Bool]) -> list[mi.Float]:
    """Weights of rows, by kind, with those of resting edges scaled to `STATIC_SHARE` of all, if there are both."""
    static_sum = sum(dr.sum(dr.select(m, 0, w)) for w, m in zip(weights, moving, strict=True))
    moving_sum = sum(dr.sum(dr.select(m, w, 0)) for w, m in zip(weights, moving, strict=True))
    both = (static_sum > 0) & (moving_sum > 0)
    scale = dr.select(both, STATIC_SHARE / (1 - STATIC_SHARE) * moving_sum / static_sum, 1)
    dr.make_opaque(scale)
    return [w * dr.select(m, 1, scale) for w, m in zip(weights, moving, strict=True)]
