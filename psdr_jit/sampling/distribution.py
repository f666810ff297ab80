"""Pick edges in proportion to a weight: a discrete distribution with stratified, exactly invertible samples."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.varying import varying


@dataclass
class EdgeDistribution:
    """Discrete distribution over edge rows. Detached. Cumulative sums in double: 10^6 rows exhaust a float."""

    cdf: mi.Float64  # inclusive cumulative weights, unnormalised
    weight: mi.Float
    total: mi.Float64  # one entry, evaluated: as a literal it would compile new kernels whenever an edge moves

    @property
    def size(self) -> int:
        return dr.width(self.weight)


def edge_distribution(weight: mi.Float) -> EdgeDistribution:
    """Distribution with probability ∝ `weight` (≥ 0, non-finite entries count as 0)."""
    weight = dr.select(dr.isfinite(weight) & (weight > 0), weight, 0)
    cdf = dr.cumsum(mi.Float64(weight))
    dr.eval(weight, cdf)
    total = dr.gather(mi.Float64, cdf, dr.width(cdf) - 1)
    dr.make_opaque(total)
    return EdgeDistribution(cdf, weight, total)


def stratified(count: int, jitter: mi.Float) -> mi.Float64:
    """`count` numbers in [0, 1), one in each stratum: (i + jitter_i) / count."""
    return (mi.Float64(dr.arange(mi.UInt32, count)) + mi.Float64(jitter)) / varying(mi.Float64, count)


def sample_edge(dist: EdgeDistribution, u: mi.Float64) -> tuple[mi.UInt32, mi.Float]:
    """Row and the re-used, again uniform, remainder of `u` ∈ [0, 1): `(row, t)`, t ∈ [0, 1)."""
    x = u * dist.total
    row = dr.binary_search(0, dist.size - 1, lambda i: dr.gather(mi.Float64, dist.cdf, i) <= x)
    row = mi.UInt32(row)
    weight = mi.Float64(dr.gather(mi.Float, dist.weight, row))
    below = dr.gather(mi.Float64, dist.cdf, row) - weight
    t = mi.Float((x - below) / weight)
    return row, dr.clip(t, 0, dr.one_minus_epsilon(mi.Float))


def pmf(dist: EdgeDistribution, row: mi.UInt32) -> mi.Float:
    """Probability of `row`."""
    return dr.gather(mi.Float, dist.weight, row) / mi.Float(dist.total)
