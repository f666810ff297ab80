"""Where the view through chains of delta vertices steps: crossings of short lines on the film with what is seen there.

A crossing between the ends of a line (`searched_lines`) shows as their chains part (`chain_trace`), and is found by
halving. Two crossings may hide each other, so some intervals whose ends agree are looked into (`chain_intervals`); on
both sides of a crossing always.

Of most crossings can be told roughly where they are (`chain_guess`): halving then looks close beside that place first,
on the one side and on the other.

As at most one part goes on, a lane of a kernel follows it, and past a crossing what lies behind; then it comes back to
what lies in front. While there are many searches that waits for the next kernel instead, and so do intervals that take
longer than others.

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
from .chain_finds import SLOTS, Finds, empty_stack, push, read
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

#: Looks at an interval and its halves in the first kernel; each further one has twice as many.
FIRST_LOOKS = 2

#: As few searches as this are followed to their ends, however long, and back to what lies in front of crossings; but no
#: more crossings than SLOTS in one kernel. Where there are more, a search pauses before it halves: it then finds one at
#: most.
FEW, UNLIMITED = 16384, 2**31


#: What a search does next: compare the ends of the whole interval, or a place inside with the near end; halve what is
#: between lo and hi, check what halving came to; or nothing.
LOOK, PROBE, HALVE, CHECK, END = range(5)


@dataclass
class Search:
    """What a lane is doing. Detached."""

    at: Interval
    mode: mi.UInt32
    lo: mi.Float
    hi: mi.Float
    moves: mi.Bool  # can the step that it halves to?
    guess: mi.Float  # where it is, or NOWHERE; where the interval is looked into

    @staticmethod
    def begin(at: Interval) -> Search:
        n = dr.width(at.sample)
        lo, hi = (dr.zeros(mi.Float, n) for _ in range(2))
        return Search(at, begun(at), lo, hi, dr.zeros(mi.Bool, n), at.middle())

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


def begun(at: Interval) -> mi.UInt32:
    """What comes first."""
    return dr.select(at.fresh, mi.UInt32(LOOK), PROBE)


@dr.syntax
def _searched(
    lines: SearchedLines, guesses: Guesses, search: Search, pause: tuple[mi.UInt32, mi.Bool], finds: Finds
) -> tuple[Search, mi.UInt32]:
    """Go on with searches until they pause or end, `(searches, segments traced by each)`; fills `finds`.

    `pause`: the number of looks after which one does, and whether one does before it begins to halve; it then does not
    come back to what lies in front of crossings, either.
    """
    most_looks, before_halving = pause
    stack, height = empty_stack(), mi.UInt32(0)
    least, narrowest = lines.least_width, lines.narrowest
    search = dr.select(mi.Bool(True), search, search)
    looks, slot, segments, active = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0), search.mode != END
    while dr.hint(
        active, label="psdr.chain.search", exclude=[lines, guesses, finds, most_looks, before_halving, least]
    ):
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
        again = checked & pair.differs & moves & (hi - lo > least)  # taken for one that rests
        crossed = checked & pair.differs & ~again

        found = Crossing(Interval(at.sample, lo, hi, at.weight, at.key, at.fresh, at.uneven), pair.k)
        finds.write(slot, moves & ~pair.chosen & (pair.k >= lines.first_kept), found, crossed)
        front = at.part(at.lo, dr.select(moves, lo, hi), FRONT, pair.chosen, ~moves)
        kept, part = front.kept(mi.Bool(True), mi.Bool(False), narrowest)
        finds.write_front(slot, part, crossed & kept & before_halving)
        height = push(stack, height, part, crossed & kept & ~before_halving)
        slot += dr.select(crossed, mi.UInt32(1), 0)

        kept, part, place = search.looked_into(pair, (start, end), narrowest)
        halved = apart | halve | again
        narrow = hi - lo <= dr.select(moves, least, dr.maximum(least, AT_REST))
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
        search = Search(at, mode, lo, hi, moves, guess)
        looks += dr.select(whole, mi.UInt32(1), 0)
        waits = (looks >= most_looks) | (slot == finds.slots)
        active = (mode != END) & ~(((mode <= PROBE) & waits) | (apart & before_halving))
    finds.write_rest(stack, height, search.at.sample)
    return search, segments


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
    found, looks = [], FIRST_LOOKS
    smooth = any(shape.smooth for shape in lines.job.facts.shapes)
    guesses = Guesses(lines.analytic, lines.copies, lines.job.surfaces, smooth)
    while left is not None:
        left = _stored(left)
        many = _width(left) > FEW
        finds = Finds(_width(left), 1 if many else SLOTS)
        pause = varying(mi.UInt32, looks if many else UNLIMITED), varying(mi.Bool, many)
        search, segments = _searched(lines, guesses, left, pause, finds)
        dr.eval(search, segments, finds.crossing, finds.before, finds.found, finds.goes_on)
        lines.tell_effort(left.at.sample, segments)
        found.append(compact(finds.crossing, finds.found))
        before = compact(finds.before, finds.goes_on)
        halving = (search.mode == HALVE) | (search.mode == CHECK)
        # Those that halve, which takes long, side by side.
        parts = [compact(search, halving), compact(search, search.mode <= PROBE)]
        left = _joined([*parts, None if before is None else Search.begin(before)])
        looks *= 2
    return _joined(found)
