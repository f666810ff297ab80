"""The texels of patches, as cells: which of them are crossed by curves, as they are seen from one sensor.

A fine map bends the normals of a patch hundreds of times, and turns them from the viewer in few places. Of the places
that t picks on a patch, most would hold no curve. So t picks a block of texels, with a probability that grows with how
much of it curves cross and by how much radiance steps there, and one of its texels. None that holds a part of the patch
has probability 0. As all this depends on the viewpoint, it is found anew for every call.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from .bent_looks import IN_RECTANGLE, Looks
from .bent_rows import BentRows
from .bent_surface import BentSurface
from .bent_texels import Block, Texels, those_that

#: Blocks of all patches together, about: per pixel, at least and at most. They are larger if there would be more.
PER_PIXEL, LEAST_CELLS, MOST_CELLS = 4, 2**17, 2**21

#: Size of patches that are not cut, in texels.
SMALL = 0.5

#: Step of radiance that is counted on, at least: a map may bend normals between the places that are looked at.
LEAST_STEP = 1e-2


@dataclass
class Cell:
    """The part of a texel that lies in the box of a patch; one per lane."""

    low: mi.Point2f  # in texel coordinates
    high: mi.Point2f
    pmf: mi.Float  # of this one, of all of the patch
    t: mi.Float  # what is left of the number that has picked it: uniform in [0, 1)


@dataclass(frozen=True)
class Cells:
    """The blocks of all patches, row by row. Cumulative sums in double, as of `sampling.distribution`."""

    first: mi.UInt32  # by row: number of its first block
    number: mi.UInt32  # by row: of its blocks; 0 where it is not cut
    side: mi.UInt32  # of a block, in texels
    weight: mi.Float  # by block: the share that is crossed by curves, times how radiance steps there
    cdf: mi.Float64  # by block: weights up to this one and with it

    @staticmethod
    def of(
        surface: BentSurface, rows: BentRows, wanted: mi.Bool, eye: mi.Vector4f, slack: mi.Float, pixels: int
    ) -> Cells | None:
        """Of the `wanted` rows with several texels, seen in so many pixels from `eye`, known up to `slack` [m].

        None: there are none.
        """
        most = varying(mi.Float, min(max(PER_PIXEL * pixels, LEAST_CELLS), MOST_CELLS))
        texels = Texels.of(rows)
        cut = wanted & texels.has_area & (rows.texels > SMALL)
        all_texels = dr.sum(dr.select(cut, texels.all.count, 0))
        side = mi.UInt32(dr.maximum(dr.ceil(dr.sqrt(all_texels / most)), 1))
        blocks = _blocks(texels.all.number, mi.Float(side))
        number = mi.UInt32(dr.select(cut, blocks.x * blocks.y, 0))
        upto = dr.cumsum(number)
        dr.eval(side, number, upto)
        count = int(upto[dr.width(upto) - 1])
        if count == 0:
            return None
        first = upto - number
        index = dr.arange(mi.UInt32, count)
        row = dr.binary_search(0, dr.width(upto) - 1, lambda i: dr.gather(mi.UInt32, upto, i) <= index)
        row = mi.UInt32(row)
        own = dr.gather(BentRows, rows, row)
        of_row = Texels.of(own)
        block = _block(of_row, index - dr.gather(mi.UInt32, first, row), side)
        low, high = of_row.rectangle(block)
        places = [of_row.inside(low, high, mi.Point2f(*place)) for place in IN_RECTANGLE.places]
        looks = Looks.of(surface, own, places, IN_RECTANGLE)
        size = dr.norm(high - low) / (mi.Float(side) * dr.sqrt(2.0))
        weight = looks.seen(eye, slack).crossed() * dr.maximum(looks.step, LEAST_STEP) * size
        weight = dr.select(of_row.holds(block), weight, 0)
        cdf = dr.cumsum(mi.Float64(weight))
        dr.eval(first, weight, cdf)
        return Cells(first, number, side, weight, cdf)

    def crossed(self, rows: BentRows) -> mi.Float:
        """By row, the share of its blocks that is crossed, times the step and how many blocks are along its side: in
        proportion to the length of curves, in sizes of the patch. 0 where it is not cut.
        """
        total = mi.Float(self._upto(self.first + self.number) - self._upto(self.first))
        return dr.select(self.number > 0, total * mi.Float(self.side) / rows.texels, 0)

    def pick(self, row: mi.UInt32, rows: BentRows, t: mi.Float, active: mi.Bool) -> Cell:
        """A texel of `row`; of one that is not cut, each with the same probability."""
        texels = Texels.of(rows)
        first, number = (dr.gather(mi.UInt32, column, row, active) for column in (self.first, self.number))
        is_cut = active & (number > 0)
        end = first + number
        low, high = self._upto(first, is_cut), self._upto(end, is_cut)
        x = low + mi.Float64(t) * (high - low)
        block = self._where(x, first, end - 1, is_cut)
        weight = dr.gather(mi.Float, self.weight, block, is_cut)
        left = mi.Float((x - self._upto(block, is_cut)) / mi.Float64(weight))
        part, every = _block(texels, block - first, self.side), texels.all
        chosen = Block(dr.select(is_cut, part.first, every.first), dr.select(is_cut, part.number, every.number))
        pmf = dr.select(is_cut, weight / mi.Float(high - low), 1)
        return _one_texel(texels, chosen, pmf, dr.select(is_cut, dr.clip(left, 0, 1), t), active)

    def _where(self, x: mi.Float64, first: mi.UInt32, last: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The block from `first` to `last` whose weights go beyond x. A loop: `dr.binary_search` would be compiled anew
        for each number of blocks.
        """

        def goes_on(first: mi.UInt32, last: mi.UInt32) -> mi.Bool:
            return active & (first < last)

        def halved(first: mi.UInt32, last: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
            middle = (first + last) >> 1
            after = self._upto(middle + 1, active) <= x
            return dr.select(after, middle + 1, first), dr.select(after, last, middle)

        return dr.while_loop((first, last), goes_on, halved, label="which block")[0]

    def _upto(self, block: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float64:
        """Weight of all blocks before this one."""
        return dr.gather(mi.Float64, self.cdf, block - 1, active & (block > 0))


def uniform_cell(rows: BentRows, t: mi.Float, active: mi.Bool) -> Cell:
    """A texel of a patch, each with the same probability."""
    texels = Texels.of(rows)
    return _one_texel(texels, texels.all, mi.Float(1), t, active)


def _one_texel(texels: Texels, block: Block, pmf: mi.Float, t: mi.Float, active: mi.Bool) -> Cell:
    """Of those of a block of probability `pmf` that may hold a part of the patch, each with the same one."""

    def fits(which: mi.UInt32) -> mi.Bool:
        return texels.holds(block.texel(which))

    every = mi.UInt32(block.count)
    number = dr.maximum(those_that(fits, every, every, active)[1], 1)
    t = t * mi.Float(number)  # not in place: it is the caller's
    before = dr.minimum(mi.UInt32(t), number - 1)
    end, found = those_that(fits, every, before, active)
    low, high = texels.rectangle(block.texel(dr.maximum(end, 1) - 1))
    left = dr.clip(t - mi.Float(before), 0, dr.one_minus_epsilon(mi.Float))
    return Cell(low, high, dr.select(found > 0, pmf / mi.Float(number), 0), left)


def _block(texels: Texels, which: mi.UInt32, side: mi.UInt32) -> Block:
    """The one with this number; at the end of a patch, blocks are smaller."""
    every, side = texels.all, mi.Float(side)
    place = Block(mi.Point2f(0), _blocks(every.number, side)).texel(which).first
    return Block(mi.Point2f(every.first + side * place), mi.Point2f(dr.minimum(side, every.number - side * place)))


def _blocks(texels: mi.Point2f, side: mi.Float) -> mi.Point2f:
    """How many there are along both axes."""
    return mi.Point2f(dr.ceil(texels / side))
