"""Where the view through chains of delta vertices steps: crossings of short lines on the film with what is seen there.

Every sample is a line across one pixel, horizontal or vertical. A crossing between its ends shows in that their chains
part (`chain_trace`), and is found by halving. Two crossings may hide each other, so an interval is looked at again:
where its ends agree, with probability q < 1/2, cut at a random point near its middle and with 1/q of its weight; on
both sides of a crossing always. Every crossing is then found with expected weight 1, however small what it bounds, and
the cost is that of 1/(1 − 2q) intervals; a small q is cheap, and noisy at corners. Only float32 sets a limit: intervals
end at the width at which rays can be told apart.

Crossings of the first segment are not kept, only walked around: they belong to the primary boundary.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.film import sampled_window
from ..core.low_discrepancy import lane_sampler, pixel_sampler
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..paths.rays import skip_emitters
from ..plan.job import Job
from ..plan.probe_motion import registry_table
from .chain_fixed import Directions
from .chain_patterns import ChainPatterns
from .chain_trace import CHAIN_DEPTH, ChainRecords, ChainWorld, Pair, guide, trace_pair

#: Probability with which an interval is cut though its ends agree: where they see a delta lobe, and elsewhere.
CUT_SHARE, CUT_SHARE_ELSEWHERE = 0.4, 0.2

#: Range of the cut, of the interval: pieces that shrink fast find what is narrow after fewer cuts, with less weight.
CUT_SPREAD = 0.1

#: Width at which halving ends [px], or relative to the film: some units in the last place of a float32 film position.
LEAST_WIDTH, ROUNDING = 2.0**-18, 5e-7


@dataclass
class Line:
    """The line of a sample on the film. Detached."""

    start: mi.Point2f  # film position [px]
    horizontal: mi.Bool
    aperture: mi.Point2f
    wavelength: mi.Float  # random number

    def at(self, s: mi.Float) -> mi.Point2f:
        """Film position [px] a share `s` of the way along."""
        return self.start + dr.select(self.horizontal, mi.Point2f(s, 0), mi.Point2f(0, s))


@dataclass
class Interval:
    """A part of a line. Detached."""

    sample: mi.UInt32  # number of the line
    lo: mi.Float
    hi: mi.Float
    weight: mi.Float
    key: mi.UInt32  # of its random numbers


@dataclass
class Crossing:
    """An interval too short to be cut, whose ends see different surfaces at segment k > 0. Detached."""

    at: Interval
    k: mi.UInt32


@dataclass(frozen=True)
class Lines:
    """The lines of a job, `job.spp` across each pixel, half of them horizontal on average. Host object."""

    job: Job
    world: ChainWorld
    count: int
    pixels: tuple[int, int]
    corner: tuple[float, float]
    directions: Directions  # of their smooth vertices

    @staticmethod
    def of(job: Job) -> Lines:
        lower, upper = sampled_window(job.film)
        width, height = (int(n) for n in upper - lower)
        flat = {s.index for s in job.facts.shapes if (s.is_mesh and not s.smooth) or s.plugin == "disk"}
        depth = min(job.limits.max_depth, CHAIN_DEPTH)
        world = ChainWorld(job.scene, depth, registry_table(job.scene, flat), ChainPatterns.of(job))
        count = width * height * job.spp
        directions = Directions(count, depth)
        lines = Lines(job, world, count, (width, height), tuple(map(float, lower)), directions)
        lines._guide()
        dr.eval(directions.data)
        return lines

    def _guide(self) -> None:
        """Draw the directions of all lines."""
        sample = dr.arange(mi.UInt32, self.count)
        sampler = lane_sampler(stream_seed(self.job.seed, Stream.CHAIN_GUIDE), sample)
        ray = self.ray(self.line(sample), sampler.next_1d())
        guide(self.world, ray, self._numbers(sample), sampler, sample, self.directions)

    def _numbers(self, sample: mi.UInt32):
        """What chooses lobes and points of light, for all chains of a line."""
        return lane_sampler(stream_seed(self.job.seed, Stream.CHAIN_LOBES), sample)

    def line(self, sample: mi.UInt32) -> Line:
        rng = pixel_sampler(stream_seed(self.job.seed, Stream.CHAIN_LINE), sample, self.job.spp)
        pixel, width = sample // varying(mi.UInt32, self.job.spp), varying(mi.UInt32, self.pixels[0])
        row = pixel // width
        corner = mi.Point2f(mi.Float(pixel - row * width), mi.Float(row)) + varying(mi.Point2f, self.corner)
        horizontal, offset = rng.next_1d() < 0.5, rng.next_1d()
        aperture, wavelength = rng.next_2d(), rng.next_1d()
        start = corner + dr.select(horizontal, mi.Point2f(0, offset), mi.Point2f(offset, 0))
        return Line(start, horizontal, aperture, wavelength)

    @property
    def per_pixel(self) -> mi.Float:
        """Expected number of lines of one direction across a pixel."""
        return varying(mi.Float, self.job.spp / 2)

    def film(self, p: mi.Point2f) -> mi.Point2f:
        """Film position p [px] in [0, 1]² of the crop window."""
        frame = self.job.frame
        return (p - varying(mi.Point2f, frame.crop_offset)) / varying(mi.Point2f, frame.crop_size)

    def ray(self, line: Line, s: mi.Float) -> mi.Ray3f:
        """The camera ray, behind the emitters that are hidden from the camera."""
        ray, _ = self.job.sensor.sample_ray(0, line.wavelength, self.film(line.at(s)), line.aperture)
        if not self.job.options.hide_emitters:
            return mi.Ray3f(ray)
        return skip_emitters(self.job.scene, ray, self.job.scene.ray_intersect_preliminary(ray))[0]

    def compare(self, at: Interval, store: ChainRecords | None = None) -> Pair:
        """The chains from both ends of the intervals."""
        line = self.line(at.sample)
        rays = self.ray(line, at.lo), self.ray(line, at.hi)
        return trace_pair(self.world, rays, self._numbers(at.sample), (self.directions, at.sample), store)

    @property
    def least_width(self) -> mi.Float:
        return varying(mi.Float, max(LEAST_WIDTH, ROUNDING * max(self.job.frame.crop_size)))


def _halved(lines: Lines, at: Interval) -> Interval:
    """The part of an interval in which the chains first part, as short as can be."""
    least, lo, hi = lines.least_width, mi.Float(at.lo), mi.Float(at.hi)
    return _halving_loop(lines, at, lo, hi, least)


@dr.syntax
def _halving_loop(lines: Lines, at: Interval, lo: mi.Float, hi: mi.Float, least: mi.Float):
    while dr.hint(hi - lo > least, label="psdr.chain.halving", exclude=[lines]):
        middle = 0.5 * (lo + hi)
        pair = lines.compare(Interval(at.sample, lo, middle, at.weight, at.key))
        hi = dr.select(pair.differs, middle, hi)
        lo = dr.select(pair.differs, lo, middle)
    return Interval(at.sample, lo, hi, at.weight, at.key)


def _uniform(key: mi.UInt32, which: int) -> mi.Float:
    return mi.Float(mi.sample_tea_32(key, mi.UInt32(which))[0] >> 8) * 2.0**-24


def _sides(at: Interval, left: mi.Float, right: mi.Float, weight: mi.Float) -> Interval:
    """What lies in front of `left` and behind `right`, one after the other: two intervals each."""
    index = dr.arange(mi.UInt32, 2 * dr.width(at.sample))
    behind, i = (index & 1) == 1, index >> 1
    at, left, right, weight = (dr.gather(type(v), v, i) for v in (at, left, right, weight))
    key = mi.sample_tea_32(at.key, 2 + (index & 1))[0]
    return Interval(at.sample, dr.select(behind, right, at.lo), dr.select(behind, at.hi, left), weight, key)


def _cut(lines: Lines, at: Interval, maybe: mi.Bool, specular: mi.Bool) -> Interval | None:
    """Intervals whose ends agree, some of them cut at a random point."""
    wide = at.hi - at.lo > lines.least_width
    share = dr.select(specular, mi.Float(CUT_SHARE), CUT_SHARE_ELSEWHERE)
    weighted = Interval(at.sample, at.lo, at.hi, at.weight / share, at.key)
    chosen = compact(weighted, maybe & wide & (_uniform(at.key, 0) < share))
    if chosen is None:
        return None
    point = dr.lerp(chosen.lo, chosen.hi, 0.5 + CUT_SPREAD * (_uniform(chosen.key, 1) - 0.5))
    return _sides(chosen, point, point, chosen.weight)


def _joined(parts: list) -> Interval | Crossing | None:
    """Several of the same kind as one, evaluated. `dr.concat` would compile a kernel for every number of them."""
    parts = [part for part in parts if part is not None]
    if not parts:
        return None
    dr.eval(parts)
    joined = parts[0]
    for part in parts[1:]:
        size, i = _width(joined), dr.arange(mi.UInt32, _width(joined) + _width(part))
        behind = varying(mi.UInt32, size)
        first = i < behind
        head = dr.gather(type(part), joined, i, first)
        joined = dr.select(first, head, dr.gather(type(part), part, i - behind, ~first))
        dr.eval(joined)
    return joined


def _width(part: Interval | Crossing) -> int:
    return dr.width(part.k if isinstance(part, Crossing) else part.sample)


def find_crossings(lines: Lines) -> Crossing | None:
    """All crossings that the lines' intervals lead to; None if there are none."""
    n = lines.count
    sample = dr.arange(mi.UInt32, n)
    key = mi.sample_tea_32(stream_seed(lines.job.seed, Stream.CHAIN_CUTS), sample)[0]
    left = Interval(sample, dr.zeros(mi.Float, n), dr.ones(mi.Float, n), dr.ones(mi.Float, n), key)
    found = []
    while left is not None:
        pair = lines.compare(left)
        apart, specular = pair.differs & pair.specular, mi.Bool(pair.specular)
        dr.eval(left, apart, specular)
        both = compact(left, apart)
        nexts = [_cut(lines, left, ~apart, specular)]
        if both is not None:
            crossing, behind = _crossings(lines, both)
            found.append(crossing)
            nexts += behind
        left = _joined(nexts)
    return _joined(found)


def _crossings(lines: Lines, at: Interval) -> tuple[Crossing | None, list[Interval | None]]:
    """A crossing in each interval whose ends see different things, and what is left of the intervals."""
    short = _halved(lines, at)
    dr.eval(short)
    pair = lines.compare(short)
    sure, k = mi.Bool(pair.differs), mi.UInt32(pair.k)
    dr.eval(at, short, sure, k)
    rest = [_cut(lines, at, ~sure, mi.Bool(True))]
    chosen = compact(at, sure)
    if chosen is not None:
        crossed = compact(short, sure)
        rest.append(_sides(chosen, crossed.lo, crossed.hi, chosen.weight))
    return compact(Crossing(short, k), sure & (k > 0)), rest
