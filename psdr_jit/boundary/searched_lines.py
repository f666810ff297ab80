"""Lines whose chains are searched for where they part (`chain_search`), whatever they lie across.

Those across the film start at the sensor (`chain_lines`), those across what lights shine on at the lights
(`light_chain_lines`). What the chains of a line have in common is drawn in the same way for both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..core.low_discrepancy import lane_sampler
from ..core.streams import Stream, stream_seed
from ..edges.copy_table import CopyTable
from ..plan.job import Job
from .chain_fixed import Directions
from .chain_outline import AnalyticShapes
from .chain_trace import ChainRecords, Pair, guide, trace_pair
from .chain_world import ChainWorld


def either(u: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """One of two at even chances, and what is left of the random number `u`: uniform, well spread within each."""
    first = u < 0.5
    return first, dr.select(first, 2 * u, 2 * u - 1)


class SearchedLines(ABC):
    """The lines of a job, numbered from 0. Host object."""

    job: Job
    world: ChainWorld
    directions: Directions  # of their smooth vertices
    narrowest: float  # intervals as short as this are not cut
    first_kept: int  # segment: steps of those before are left to others
    count: int  # number of lines

    @abstractmethod
    def line(self, sample: mi.UInt32):
        """The lines number `sample`; what chooses their delta lobes is their `lobe`."""

    @abstractmethod
    def ray(self, line, s: mi.Float) -> mi.Ray3f:
        """The first segment of the chain from a share `s` of the way along."""

    @property
    @abstractmethod
    def least_width(self) -> mi.Float:
        """Width at which halving ends."""

    @cached_property
    def analytic(self) -> AnalyticShapes | None:
        """The shapes without triangles that their chains may meet."""
        return AnalyticShapes.of(self.job)

    @property
    def copies(self) -> CopyTable | None:
        """What stands for what instances show."""
        return self.world.surfaces.copies

    def guide(self) -> None:
        """Draw the directions of all lines, if anything scatters light."""
        if not self.world.scatters:
            return
        sample = dr.arange(mi.UInt32, self.count)
        sampler = lane_sampler(stream_seed(self.job.seed, Stream.CHAIN_GUIDE), sample)
        line = self.line(sample)
        ray = self.ray(line, sampler.next_1d())
        guide(self.world, ray, (self._numbers(sample), line.lobe), sampler, sample, self.directions)
        dr.eval(self.directions.data)

    def tell_effort(self, sample: mi.UInt32, segments: mi.UInt32) -> None:  # noqa: B027 (not all lines are on the film)
        """So many segments have been traced for the lines `sample`; for `Job.effort`."""

    def _numbers(self, sample: mi.UInt32):
        """What chooses smooth lobes and the points at the other end, for all chains of a line."""
        return lane_sampler(stream_seed(self.job.seed, Stream.CHAIN_LOBES), sample)

    def compare(self, sample: mi.UInt32, ends: tuple[mi.Float, mi.Float], store: ChainRecords | None = None) -> Pair:
        """The chains from two places on the lines `sample`."""
        line = self.line(sample)
        rays = self.ray(line, ends[0]), self.ray(line, ends[1])
        return trace_pair(self.world, rays, (self._numbers(sample), line.lobe), (self.directions, sample), store)
