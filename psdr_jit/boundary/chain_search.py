"""Where the view through chains of delta vertices steps: crossings of short lines on the film with what is seen there.

A crossing between the ends of a line (`searched_lines`) shows as their chains part (`chain_trace`), and is found by
halving. Two crossings may hide each other, so an interval is looked at again: where its ends agree it is cut into n
parts, and each goes on in its place with probability s/n and n/s of its weight; on both sides of a crossing always.
Every crossing is then found with expected weight 1. What is narrower by a factor n, such as the last bit of a corner,
is found with a weight larger by n/s, and by so many fewer lines that each power of n adds 1/s times as much to the
variance: with s = 0.6 throughout, corners of a small light in a curved mirror were 95 % of it. So few intervals are
looked at again, but those down to what is too narrow to matter.

Of most crossings can be told roughly where they are (`chain_guess`): halving then looks close beside that place first,
on the one side and on the other.

As at most one part goes on, a lane of a kernel follows it, and past a crossing what lies behind; then it comes back to
what lies in front. While there are many searches that waits for the next kernel instead, and so do intervals that take
longer than others.

Steps of what cannot move are walked around in wide bends: what they leave over counts with the part in front, whose
ends agree otherwise. Crossings of segments before `lines.first_kept` are not kept either: of camera rays, those of the
first segment belong to the primary boundary. Nor are places where chains choose another lobe; what lies in front of one
is looked at as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from .chain_guess import NOWHERE, Guesses
from .searched_lines import SearchedLines

#: Into how many parts an interval is cut, and by up to which share of a part its borders are moved at random.
PARTS, CUT_SPREAD = 3, 0.3

#: With which probability one of them goes on where the ends agree: if they see a delta lobe, and the interval is
#: not such a part, or is one; and elsewhere.
GO_ON, GO_ON_AGAIN, GO_ON_ELSEWHERE = 0.5, 0.9, 0.3

#: Width at which halving ends on steps that rest [px]: they are only walked around.
AT_REST = 2.0**-4

#: How far beside a guess halving looks, times the squared width of the interval [1/px]: as the error of a linear one.
BESIDE = 2.0**-5

#: Looks at an interval and its halves in the first kernel; each further one has twice as many.
FIRST_LOOKS = 2

#: As few searches as this are followed to their ends, however long, and back to what lies in front of crossings; but no
#: more crossings than SLOTS in one kernel. Where there are more, a search pauses before it halves: it then finds one at
#: most.
FEW, SLOTS, UNLIMITED = 16384, 8, 2**31


@dataclass
class Interval:
    """A part of a line. Detached."""

    sample: mi.UInt32  # number of the line
    lo: mi.Float
    hi: mi.Float
    weight: mi.Float
    key: mi.UInt32  # of its random numbers

    @staticmethod
    def made(make, size: int) -> Interval:
        """`size` of them by `make`, see `Hit.made`."""
        return Interval(make(mi.UInt32, size), *(make(mi.Float, size) for _ in range(3)), make(mi.UInt32, size))


@dataclass
class Crossing:
    """An interval too short to be cut, whose ends see different surfaces at segment k. Detached."""

    at: Interval
    k: mi.UInt32


def _uniform(key: mi.UInt32, which: int) -> mi.Float:
    return mi.Float(mi.sample_tea_32(key, mi.UInt32(which))[0] >> 8) * 2.0**-24


def _part(at: Interval, specular: mi.Bool, narrowest: float) -> tuple[mi.Bool, Interval]:
    """`(is one looked at, which)`: a random part of an interval whose ends agree."""
    share = dr.select(specular, dr.select(at.weight == 1, mi.Float(GO_ON), GO_ON_AGAIN), GO_ON_ELSEWHERE)
    choice = _uniform(at.key, 0) / share
    chosen, part = (at.hi - at.lo > narrowest) & (choice < 1), dr.minimum(mi.UInt32(PARTS * choice), PARTS - 1)

    def cut(i: mi.UInt32) -> mi.Float:
        """The border between parts i − 1 and i."""
        jitter = CUT_SPREAD * (_uniform(at.key, PARTS + i) - 0.5)
        return dr.lerp(at.lo, at.hi, (i + dr.select((i > 0) & (i < PARTS), jitter, 0)) / PARTS)

    return chosen, Interval(at.sample, cut(part), cut(part + 1), at.weight * PARTS / share, _key(at, part))


def _key(at: Interval, which) -> mi.UInt32:
    """Of a part of an interval, by its number."""
    return mi.sample_tea_32(at.key, 1 + which)[1]


@dataclass
class Search:
    """What a lane is doing. Detached."""

    at: Interval
    mode: mi.UInt32  # LOOK at the whole interval, HALVE it between lo and hi, CHECK what halving came to, or END
    lo: mi.Float
    hi: mi.Float
    moves: mi.Bool  # can the step that it halves to?
    guess: mi.Float  # where it is, or NOWHERE

    def middle(self, least: mi.Float) -> mi.Float:
        """Where the interval [lo, hi] is cut."""
        off = dr.maximum(BESIDE * dr.square(self.hi - self.lo), 0.25 * least)
        guess = dr.clip(self.guess, self.lo, self.hi)
        beside = guess + dr.select(guess - self.lo < self.hi - guess, off, -off)
        inside = (dr.abs(guess - self.guess) < off) & (beside > self.lo) & (beside < self.hi)
        return dr.select(inside, beside, 0.5 * (self.lo + self.hi))

    @staticmethod
    def begin(at: Interval) -> Search:
        n = dr.width(at.sample)
        nothing = dr.zeros(mi.Float, n)
        return Search(at, dr.full(mi.UInt32, LOOK, n), nothing, mi.Float(nothing), dr.zeros(mi.Bool, n),
                      dr.full(mi.Float, NOWHERE, n))  # fmt: skip


LOOK, HALVE, CHECK, END = range(4)


class Finds:
    """Crossings of `lanes` searches, up to `slots` each, with what lies in front of each. Not a PyTree."""

    def __init__(self, lanes: int, slots: int):
        self.stride, self.lane = varying(mi.UInt32, lanes), dr.arange(mi.UInt32, lanes)
        self.slots = varying(mi.UInt32, slots)
        n = lanes * slots
        self.crossing = Crossing(Interval.made(dr.zeros, n), dr.zeros(mi.UInt32, n))
        self.before = Interval.made(dr.zeros, n)
        self.found, self.goes_on = dr.zeros(mi.Bool, n), dr.zeros(mi.Bool, n)
        dr.make_opaque(self.crossing, self.before, self.found, self.goes_on)

    def write(self, slot: mi.UInt32, kept: mi.Bool, crossing: Crossing, active: mi.Bool) -> None:
        """A crossing, and whether it is kept."""
        active = active & (slot < self.slots)
        self._scatter(slot, ((self.crossing, crossing), (self.found, kept)), active)

    def write_front(self, slot: mi.UInt32, front: Interval, active: mi.Bool) -> None:
        """An interval in front of a crossing that a later kernel goes on with."""
        active = active & (slot < self.slots)
        self._scatter(slot, ((self.before, front), (self.goes_on, mi.Bool(True))), active)

    def _scatter(self, slot: mi.UInt32, pairs: tuple, active: mi.Bool) -> None:
        for buffer, value in pairs:
            dr.scatter(buffer, value, slot * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)


#: A stack of intervals: bounds and weight, key. One place more than it holds takes what is written nowhere: masks of
#: `dr.Local` are not to be relied on (Dr.Jit 1.5, LLVM).
Stack = tuple[dr.Local, dr.Local]


def _stack() -> Stack:
    return dr.alloc_local(mi.Vector3f, SLOTS + 1), dr.alloc_local(mi.UInt32, SLOTS + 1)


def _push(stack: Stack, height: mi.UInt32, at: Interval, active: mi.Bool) -> mi.UInt32:
    """The height afterwards."""
    for store, value in zip(stack, (mi.Vector3f(at.lo, at.hi, at.weight), at.key), strict=True):
        store.write(value, dr.select(active, height, SLOTS))
    return height + dr.select(active, mi.UInt32(1), 0)


def _read(stack: Stack, i: mi.UInt32, sample: mi.UInt32) -> Interval:
    """Number `i`, from the bottom; all are of the line `sample`."""
    bounds, key = (store.read(i) for store in stack)
    return Interval(sample, *bounds, key)


@dr.syntax
def _searched(
    lines: SearchedLines, guesses: Guesses, search: Search, pause: tuple[mi.UInt32, mi.Bool], finds: Finds
) -> Search:
    """Go on with searches until they pause or end; fills `finds`.

    `pause`: the number of looks after which one does, and whether one does before it begins to halve; it then does not
    come back to what lies in front of crossings, either.
    """
    most_looks, before_halving = pause
    stack, height = _stack(), mi.UInt32(0)
    least = lines.least_width
    search = dr.select(mi.Bool(True), search, search)
    looks, slot, active = mi.UInt32(0), mi.UInt32(0), search.mode != END
    while dr.hint(
        active, label="psdr.chain.search", exclude=[lines, guesses, finds, most_looks, before_halving, least]
    ):
        at, look, halve = search.at, search.mode == LOOK, search.mode == HALVE
        middle = search.middle(least)
        start = dr.select(look, at.lo, search.lo)
        end = dr.select(look, at.hi, dr.select(halve, middle, search.hi))
        pair = lines.compare(at.sample, (start, end))

        apart = look & pair.differs & pair.specular
        first = halve & pair.differs & (pair.moves | ~search.moves)  # what moves is sought rather than what rests
        hi = dr.select(apart, at.hi, dr.select(first, middle, search.hi))
        lo = dr.select(apart, at.lo, dr.select(halve & ~first, middle, search.lo))
        crossed, checked = (search.mode == CHECK) & pair.differs, search.mode == CHECK
        moves = dr.select(apart | first | checked, pair.moves, search.moves)
        again = crossed & moves & (hi - lo > least)  # taken for one that rests
        crossed &= ~again
        front = Interval(at.sample, at.lo, dr.select(moves, lo, hi), at.weight, _key(at, 0))
        where = Interval(at.sample, lo, hi, at.weight, at.key)
        finds.write(slot, moves & ~pair.chosen & (pair.k >= lines.first_kept), Crossing(where, pair.k), crossed)
        goes_on, part = _part(front, mi.Bool(True), lines.narrowest)
        whole = pair.chosen & (front.hi - front.lo > lines.narrowest)  # its ends have not been compared
        before, left = dr.select(whole, front, part), crossed & (goes_on | whole)
        finds.write_front(slot, before, left & before_halving)
        height = _push(stack, height, before, left & ~before_halving)
        slot += dr.select(crossed, mi.UInt32(1), 0)

        chosen, part = _part(at, pair.specular | checked, lines.narrowest)
        behind = Interval(at.sample, hi, at.hi, at.weight, _key(at, 1))
        halved = apart | halve | again
        ends = ((look & ~apart) | (checked & ~crossed & ~again)) & ~chosen
        narrow = hi - lo <= dr.select(moves, least, dr.maximum(least, AT_REST))
        mode = dr.select(halved, dr.select(narrow, mi.UInt32(CHECK), HALVE), LOOK)
        at = dr.select(halved, at, dr.select(crossed, behind, part))
        returns = ends & (height > 0)
        height -= dr.select(returns, mi.UInt32(1), 0)
        at = dr.select(returns, _read(stack, height, at.sample), at)
        mode = dr.select(ends & ~returns, END, mode)
        guess = dr.select(apart | first, guesses.place(pair, start, end, apart | first), search.guess)
        search = Search(at, mode, lo, hi, moves, guess)
        looks += dr.select(look, mi.UInt32(1), 0)
        pauses = ((mode == LOOK) & ((looks >= most_looks) | (slot == finds.slots))) | (apart & before_halving)
        active = (mode != END) & ~pauses
    _write_rest(stack, height, search, finds)
    return search


def _write_rest(stack: Stack, height: mi.UInt32, search: Search, finds: Finds) -> None:
    """What searches that pause have not come back to."""
    for i in range(SLOTS):
        number = mi.UInt32(i)
        finds.write_front(number, _read(stack, number, search.at.sample), number < height)


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


def _width(part: Search | Crossing) -> int:
    return dr.width(part.at.sample)


def find_crossings(lines: SearchedLines) -> Crossing | None:
    """All crossings that the lines' intervals lead to; None if there are none."""
    n = lines.count
    sample = dr.arange(mi.UInt32, n)
    key = mi.sample_tea_32(stream_seed(lines.job.seed, Stream.CHAIN_CUTS), sample)[0]
    left = Search.begin(Interval(sample, dr.zeros(mi.Float, n), dr.ones(mi.Float, n), dr.ones(mi.Float, n), key))
    found, looks = [], FIRST_LOOKS
    guesses = Guesses(lines.analytic, any(shape.smooth for shape in lines.job.facts.shapes))
    while left is not None:
        many = _width(left) > FEW
        finds = Finds(_width(left), 1 if many else SLOTS)
        pause = varying(mi.UInt32, looks if many else UNLIMITED), varying(mi.Bool, many)
        search = _searched(lines, guesses, left, pause, finds)
        dr.eval(search, finds.crossing, finds.before, finds.found, finds.goes_on)
        found.append(compact(finds.crossing, finds.found))
        before = compact(finds.before, finds.goes_on)
        halving = (search.mode == HALVE) | (search.mode == CHECK)
        # Those that halve, which takes long, side by side.
        parts = [compact(search, halving), compact(search, search.mode == LOOK)]
        left = _joined([*parts, None if before is None else Search.begin(before)])
        looks *= 2
    return _joined(found)
