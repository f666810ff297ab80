"""Patches with many texels, cut into cells: which of these are crossed by curves, as they are seen from one sensor.

A fine map bends the normals of a patch hundreds of times, and turns them from the viewer in few places. Of the places
that t picks on a patch, most would hold no curve. So the patch is cut into k² triangles of about a texel, and t picks
one of them with a probability that grows with how much of it curves cross and by how much radiance steps there. No
cell has probability 0. As all this depends on the viewpoint, it is found anew for every call.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.varying import varying
from .bent_looks import Corners, Looks
from .bent_rows import BentRows
from .bent_surface import BentSurface

#: Texels along the side of a cell, at least.
TEXELS = 1.0

#: Cells of all patches together, about: per pixel, at least and at most. They are larger if there would be more.
PER_PIXEL, LEAST_CELLS, MOST_CELLS = 16, 2**16, 2**21

#: Step of radiance that is counted on, at least: a map may bend normals between the places that are looked at.
LEAST_STEP = 1e-2


@dataclass
class Cell:
    """A part of a patch, one per lane."""

    corners: Corners
    per_side: mi.Float  # how many of them are along a side of the patch
    pmf: mi.Float  # of this one
    t: mi.Float  # what is left of the number that has picked it: uniform in [0, 1)


@dataclass(frozen=True)
class Cells:
    """Those of all patches, row by row. Cumulative sums in double, as of `sampling.distribution`."""

    first: mi.UInt32  # by row
    per_side: mi.UInt32  # by row: how many along the side of a patch, whose cells are the square; or 0
    weight: mi.Float  # by cell: the share that is crossed by curves, times how radiance steps there
    cdf: mi.Float64  # by cell: weights up to this one and with it

    @staticmethod
    def of(
        surface: BentSurface, rows: BentRows, wanted: mi.Bool, eye: mi.Vector4f, slack: mi.Float, pixels: int
    ) -> Cells | None:
        """Of the `wanted` rows with several texels, seen in so many pixels from `eye`, known up to `slack` [m].

        None: there are none.
        """
        most = min(max(PER_PIXEL * pixels, LEAST_CELLS), MOST_CELLS)
        wish = dr.select(wanted & (rows.texels > TEXELS), rows.texels / TEXELS, 0)
        number = dr.sum(dr.square(wish))
        larger = dr.maximum(dr.sqrt(number / varying(mi.Float, most)), 1)
        per_side = mi.UInt32(dr.ceil(wish / larger))
        upto = dr.cumsum(dr.square(per_side))
        dr.eval(per_side, upto)
        count = int(upto[dr.width(upto) - 1])
        if count == 0:
            return None
        first = upto - dr.square(per_side)
        index = dr.arange(mi.UInt32, count)
        row = dr.binary_search(0, dr.width(upto) - 1, lambda i: dr.gather(mi.UInt32, upto, i) <= index)
        row = mi.UInt32(row)
        corners = cell_corners(index - dr.gather(mi.UInt32, first, row), mi.Float(dr.gather(mi.UInt32, per_side, row)))
        looks = Looks.of(surface, dr.gather(BentRows, rows, row), corners)
        weight = looks.seen(eye, slack).crossed() * dr.maximum(looks.step, LEAST_STEP)
        cdf = dr.cumsum(mi.Float64(weight))
        dr.eval(first, per_side, weight, cdf)
        return Cells(first, per_side, weight, cdf)

    def crossed(self) -> mi.Float:
        """By row, the share of its cells that is crossed, times the step and how many cells are along its side: in
        proportion to the length of curves, in sizes of the patch. 0 where it is not cut.
        """
        total = mi.Float(self._upto(self.first + dr.square(self.per_side)) - self._upto(self.first))
        return dr.select(self.per_side > 0, total / mi.Float(self.per_side), 0)

    def pick(self, row: mi.UInt32, t: mi.Float, active: mi.Bool) -> Cell:
        """One of those of `row`; the whole patch, where it is not cut."""
        first, per_side = (dr.gather(mi.UInt32, column, row, active) for column in (self.first, self.per_side))
        is_cut = active & (per_side > 0)
        end = first + dr.square(per_side)
        low, high = self._upto(first, is_cut), self._upto(end, is_cut)
        x = low + mi.Float64(t) * (high - low)
        cell = self._where(x, first, end - 1, is_cut)
        weight = dr.gather(mi.Float, self.weight, cell, is_cut)
        left = mi.Float((x - self._upto(cell, is_cut)) / mi.Float64(weight))
        found = cell_corners(cell - first, mi.Float(dr.maximum(per_side, 1)))
        return Cell(
            corners=found,
            per_side=mi.Float(dr.maximum(per_side, 1)),
            pmf=dr.select(is_cut, weight / mi.Float(high - low), 1),
            t=dr.select(is_cut, dr.clip(left, 0, dr.one_minus_epsilon(mi.Float)), t),
        )

    def _where(self, x: mi.Float64, first: mi.UInt32, last: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The cell from `first` to `last` whose weights go beyond x. A loop: `dr.binary_search` would be compiled anew
        for each number of cells.
        """

        def goes_on(first: mi.UInt32, last: mi.UInt32) -> mi.Bool:
            return active & (first < last)

        def halved(first: mi.UInt32, last: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
            middle = (first + last) >> 1
            after = self._upto(middle + 1, active) <= x
            return dr.select(after, middle + 1, first), dr.select(after, last, middle)

        return dr.while_loop((first, last), goes_on, halved, label="which cell")[0]

    def _upto(self, cell: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float64:
        """Weight of all cells before this one."""
        return dr.gather(mi.Float64, self.cdf, cell - 1, active & (cell > 0))


def cell_corners(number: mi.UInt32, per_side: mi.Float) -> Corners:
    """Of the cells of a patch: in units of their size, those with b1 + b2 between i and i + 1 count from i² on."""
    i = dr.floor(dr.sqrt(mi.Float(number) + 0.5))  # half a number off, where rounding is no matter
    place = mi.Float(number) - i * i
    m = dr.floor(place / 2)
    upright = place == 2 * m
    apex, right = mi.Vector2f(i - m, m), mi.Vector2f(i - m, m + 1)
    left = dr.select(upright, mi.Vector2f(i + 1 - m, m), mi.Vector2f(i - m - 1, m + 1))
    return Corners(*(mi.Point2f(corner / per_side) for corner in (apex, left, right)))
