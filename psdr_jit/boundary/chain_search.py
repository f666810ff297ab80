"""Where the view through chains of delta vertices steps: crossings of short lines on the film with what is seen there.

A crossing between the ends of a line (`searched_lines`) shows as their chains part (`chain_trace`), and is found by
halving. Two crossings may hide each other, so some intervals whose ends agree are looked into (`chain_intervals`); on
both sides of a crossing always.

Of most crossings can be told roughly where they are (`chain_guess`): halving then looks close beside that place first,
on the one side and on the other.

As at most one part goes on, a lane of a kernel follows it, and past a crossing what lies behind; then it comes back to
what lies in front. Some searches take a hundred times as long as most: lanes that are done take up the next of the
queue, so that all of those that go on side by side have something to do. (One search for each lane, sorted and begun
anew after a while: of 16 lanes 4 to 8 had.)

Steps of what cannot move are walked around in wide bends: what they leave over counts with the part in front. Crossings
of segments before `lines.first_kept` are not kept either: of camera rays, those of the first segment belong to the
primary boundary. Nor are places where chains choose another lobe; what lies in front of one is looked at as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from .chain_finds import Finds, empty_stack, push, read
from .chain_guess import Guesses
from .chain_intervals import BEHIND, FRONT, Crossing, Interval
from .chain_lamps import NEAR
from .chain_trace import Pair
from .searched_lines import SearchedLines

#: Width at which halving ends on steps that rest [px]: they are only walked around.
AT_REST = 2.0**-4

#: How far beside a guess halving looks, times the squared width of the interval [1/px]: as the error of a linear one.
BESIDE = 2.0**-5

#: How far from the middle of an interval, in shares of its width, a lamp is looked for: at the ends there is none.
WITHIN = 0.5 - 2.0**-4

#: Lanes of a kernel: for each thread of a processor, and on a GPU.
LANES_OF_THREAD, LANES_OF_GPU = 256, 2**18

#: What a search does next: nothing; or compare the ends of the whole interval, or a place inside with the near end;
#: halve what is between lo and hi, check what halving came to.
END, LOOK, PROBE, HALVE, CHECK = range(5)


@dataclass
class Search:
    """What a lane is doing. Detached."""

    at: Interval
    mode: mi.UInt32
    lo: mi.Float
    hi: mi.Float
    moves: mi.Bool  # can the step that it halves to?
    width: mi.Float  # at which halving ends
    guess: mi.Float  # where it is, or NOWHERE; where the interval is looked into

    @staticmethod
    def begin(at: Interval) -> Search:
        n = dr.width(at.sample)
        lo, hi, width = (dr.zeros(mi.Float, n) for _ in range(3))
        return Search(at, begun(at), lo, hi, dr.zeros(mi.Bool, n), width, at.middle())

    def compared(self, least: mi.Float) -> tuple[mi.Float, mi.Float]:
        """The places whose chains are compared next."""
        at, whole = self.at, self.mode <= PROBE
        halfway = dr.select(self.mode == HALVE, self.middle(least), self.hi)
        into = dr.select(self.mode == PROBE, self.guess, at.hi)
        return dr.select(whole, at.lo, self.lo), dr.select(whole, into, halfway)

    def middle(self, least: mi.Float) -> mi.Float:
        """Where what is between lo and hi is halved."""
        off = dr.maximum(BESIDE * dr.square(self.hi - self.lo), 0.25 * least)
        guess = dr.clip(self.guess, self.lo, self.hi)
        beside = guess + dr.select(guess - self.lo < self.hi - guess, off, -off)
        inside = (dr.abs(guess - self.guess) < off) & (beside > self.lo) & (beside < self.hi)
        return dr.select(inside, beside, 0.5 * (self.lo + self.hi))

    def looked_into(self, pair: Pair, ends: tuple[mi.Float, mi.Float], narrowest: float) -> tuple:
        """`(is one looked into, the interval, at which place)` where the places compared agree."""
        start, end = ends
        probes, checks = self.mode == PROBE, self.mode == CHECK
        lamp = ~checks & (pair.miss < NEAR) & (dr.abs(pair.lamp - 0.5) < WITHIN)
        half = self.at.half(dr.select(probes, self.guess, self.at.middle()))
        part = dr.select(self.mode == LOOK, self.at, half)
        part.fresh, part.uneven = (checks | (probes & mark) for mark in (half.fresh, half.uneven))
        kept, part = part.kept(pair.specular | checks, lamp, narrowest)
        return kept, part, dr.select(lamp, dr.lerp(start, end, pair.lamp), part.middle())


def _enough(pair: Pair, least: mi.Float, narrowest: float) -> mi.Float:
    """Width at which halving ends where these part. By the choice of a lobe: what is narrower is not looked into."""
    return dr.maximum(least, dr.select(pair.moves, dr.select(pair.chosen, mi.Float(narrowest), 0), AT_REST))


def begun(at: Interval) -> mi.UInt32:
    """What comes first."""
    return dr.select(at.fresh, mi.UInt32(LOOK), PROBE)


@dr.syntax
def _search(lines: SearchedLines, guesses: Guesses, queue: Search, finds: Finds) -> None:
    """Go on with the searches of a `queue` until they end, or have found as much as `finds` holds; fills it.

    Lanes that are done with a search take up the next one of the queue.
    """
    waiting, task = varying(mi.UInt32, _width(queue)), dr.arange(mi.UInt32, min(_width(queue), _lanes()))
    taken, stack, height = varying(mi.UInt32, dr.width(task)), empty_stack(), mi.UInt32(0)
    least, narrowest = lines.least_width, lines.narrowest
    search = dr.gather(Search, queue, task)
    active = search.mode != END
    slot, segments = mi.UInt32(0), mi.UInt32(0)
    while dr.hint(active, label="psdr.chain.search", exclude=[lines, guesses, queue, finds, waiting, taken, least]):
        at, whole, halve = search.at, search.mode <= PROBE, search.mode == HALVE
        start, end = search.compared(least)
        pair = lines.compare(at.sample, (start, end))
        segments += 2 * (pair.last + 1)

        # Without a width there is nothing to be found, whatever the ends are taken for.
        apart, checked = whole & pair.differs & pair.specular & (start < end), search.mode == CHECK
        first = halve & pair.differs & (pair.moves | ~search.moves)  # what moves is sought rather than what rests
        hi = dr.select(apart | first, end, search.hi)
        lo = dr.select(apart, start, dr.select(halve & ~first, end, search.lo))
        moves = dr.select(apart | first | checked, pair.moves, search.moves)
        width = dr.select(apart | first | checked, _enough(pair, least, narrowest), search.width)
        again = checked & pair.differs & (hi - lo > width)  # taken for something else
        crossed = active & checked & pair.differs & ~again

        found = Crossing(Interval(at.sample, lo, hi, at.weight, at.key, at.fresh, at.uneven), pair.k)
        finds.write(task, slot, moves & ~pair.chosen & (pair.k >= lines.first_kept), found, crossed)
        front = at.part(at.lo, dr.select(moves, lo, hi), FRONT, pair.chosen, ~moves)
        kept, part = front.kept(mi.Bool(True), mi.Bool(False), narrowest)
        height = push(stack, height, part, crossed & kept)
        slot += dr.select(crossed, mi.UInt32(1), 0)

        kept, part, place = search.looked_into(pair, (start, end), narrowest)
        halved = apart | halve | again
        narrow = hi - lo <= width
        behind = at.part(hi, at.hi, BEHIND, mi.Bool(True), mi.Bool(False))
        at = dr.select(halved, at, dr.select(crossed, behind, part))
        ends = ~halved & ~crossed & ~kept
        returns = ends & (height > 0)
        height -= dr.select(returns, mi.UInt32(1), 0)
        at = dr.select(returns, read(stack, height, at.sample), at)
        mode = dr.select(halved, dr.select(narrow, mi.UInt32(CHECK), HALVE), begun(at))
        mode = dr.select(ends & ~returns, END, mode)
        guess = dr.select(apart | first, guesses.place(pair, start, end, apart | first), search.guess)
        guess = dr.select(mode == PROBE, dr.select(returns, at.middle(), place), guess)
        search = Search(at, mode, lo, hi, moves, width, guess)

        done = active & ((mode == END) | ((mode <= PROBE) & (slot == finds.slots)))
        finds.leave(task, search, stack, height, segments, done)
        next_ = dr.scatter_inc(taken, mi.UInt32(0), done)
        task = dr.select(done, next_, task)
        active &= task < waiting
        search = dr.select(done, dr.gather(Search, queue, task, done & active), search)
        slot, segments, height = (dr.select(done, 0, number) for number in (slot, segments, height))


def _lanes() -> int:
    """How many searches go on at a time."""
    on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    return dr.thread_count() * LANES_OF_THREAD if on_cpu else LANES_OF_GPU


def _joined(parts: list) -> Search | Crossing | None:
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


def _stored(search: Search) -> Search:
    """The searches as arrays that kernels read, two or more: the first round, and the last search, then need no kernels
    of their own."""
    if _width(search) == 1:
        only = dr.arange(mi.UInt32, 2)
        search = dr.gather(Search, search, dr.zeros(mi.UInt32, 2))
        search.mode = dr.select(only == 0, search.mode, END)
    dr.make_opaque(search)
    return search


def _width(part: Search | Crossing) -> int:
    return dr.width(part.at.sample)


def find_crossings(lines: SearchedLines) -> Crossing | None:
    """All crossings that the lines' intervals lead to; None if there are none."""
    n = lines.count
    sample = dr.arange(mi.UInt32, n)
    key = mi.sample_tea_32(stream_seed(lines.job.seed, Stream.CHAIN_CUTS), sample)[0]
    left = Search.begin(Interval.whole(sample, key))
    found = []
    smooth = any(shape.smooth for shape in lines.job.facts.shapes)
    guesses = Guesses(lines.analytic, lines.copies, lines.job.surfaces, smooth)
    while left is not None:
        left = _stored(left)
        finds = Finds(left)
        _search(lines, guesses, left, finds)
        dr.eval(finds.arrays)
        lines.tell_effort(left.at.sample, finds.segments)
        found.append(compact(finds.crossing, finds.found))
        before = compact(finds.before, finds.goes_on)
        left = _joined([compact(finds.rest, finds.rest.mode != END), None if before is None else Search.begin(before)])
    return _joined(found)
