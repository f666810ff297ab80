"""An octant about a point of a grid of signed distances, within which blended normals are smooth.

Mitsuba blends the normals of the eight cells about the nearest grid point [Hansson-Söderlund et al. 2022]. In
coordinates p = (X, Y, Z) ∈ [0, ½]³ from that point, in units of cells and along axes that may be mirrored, the 27
values around it are all that counts: with s_a⁺(p) and s_a⁻(p) the slopes along axis a of the cells on the octant's side
and beyond it, taken at the other two coordinates of p, and the share c_a⁺ = ½ + p_a, c_a⁻ = ½ − p_a,

    n(p) = Σ c_X c_Y c_Z ŝ,     ŝ = s / |s|,     s = (s_X, s_Y, s_Z),     over all eight choices of signs.

The gradient of n·q, for a vector q that does not depend on p, follows with r = q − ŝ (ŝ·q) from

    ∂(n·q)/∂p_b = Σ ∂(c_X c_Y c_Z)/∂p_b (ŝ·q) + c_X c_Y c_Z (∂s/∂p_b)·r / |s|.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import drjit as dr
import mitsuba as mi

from .sdf_cell import Cell

#: The octant goes this far along each axis, in cells.
REACH = 0.5


@dataclass
class Octant:
    """Attached if its values are. One entry per sample."""

    values: dict[tuple[int, int, int], mi.Float]  # by steps −1, 0 and 1 along X, Y and Z
    ends: list[mi.Bool]  # by axis: does the grid end before the cell beyond? It does not count then

    @staticmethod
    def around(
        values: mi.Float, first: mi.UInt32, size: mi.UInt32, corner: mi.Vector3i, along: list[mi.Vector3i],
        active: mi.Bool,
    ) -> Octant:  # fmt: skip
        """About the point `corner` of a grid of `size` values a side, which begins at `first` among `values`.

        `along`: X, Y and Z as steps of the grid. Beyond its end, values go on as they are there.
        """
        last, found = mi.Int32(size) - 1, {}
        for step in product((-1, 0, 1), repeat=3):
            at = corner + along[0] * step[0] + along[1] * step[1] + along[2] * step[2]
            x, y, z = (mi.UInt32(dr.clip(at[axis], 0, last)) for axis in range(3))
            found[step] = dr.gather(mi.Float, values, first + x + size * (y + size * z), active)
        return Octant(found, [dr.any((steps > 0) & (corner == 0)) for steps in along])

    @property
    def cell(self) -> Cell:
        """The cell that the octant is a part of, from the same point on."""
        low, high = ([self.values[i, j, k] for j in (0, 1) for i in (0, 1)] for k in (0, 1))
        return Cell(low, high)

    def blended(self, p: mi.Vector3f) -> mi.Vector3f:
        """n: Mitsuba's smooth normal, of any length."""
        slopes, shares = [self._slopes(a, p) for a in range(3)], self._shares(p)
        n = mi.Vector3f(0)
        for i, j, k in product((0, 1), repeat=3):
            s = mi.Vector3f(slopes[0][i].value, slopes[1][j].value, slopes[2][k].value)
            n += shares[0][i] * shares[1][j] * shares[2][k] * _unit(s)
        return n

    def ascent(self, p: mi.Vector3f, q: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """`(n, gradient of n·q)`, q fixed."""
        slopes, shares = [self._slopes(a, p) for a in range(3)], self._shares(p)
        rises = [[dr.select(end, 0, sign) for sign in (-1.0, 1.0)] for end in self.ends]
        n, gradient = mi.Vector3f(0), mi.Vector3f(0)
        for i, j, k in product((0, 1), repeat=3):
            x, y, z = slopes[0][i], slopes[1][j], slopes[2][k]
            cx, cy, cz = shares[0][i], shares[1][j], shares[2][k]
            s = mi.Vector3f(x.value, y.value, z.value)
            unit, share = _unit(s), cx * cy * cz
            along = dr.dot(unit, q)
            n += share * unit
            r = (q - along * unit) * dr.select(share != 0, share / dr.maximum(dr.norm(s), dr.smallest(mi.Float)), 0)
            gradient += along * mi.Vector3f(rises[0][i] * cy * cz, cx * rises[1][j] * cz, cx * cy * rises[2][k])
            # a slope along one axis changes along the two that follow
            gradient += mi.Vector3f(
                y.second * r.y + z.first * r.z, z.second * r.z + x.first * r.x, x.second * r.x + y.first * r.y
            )
        return n, gradient

    def _shares(self, p: mi.Vector3f) -> list[list[mi.Float]]:
        """By axis: of the cells beyond the octant, and on its side."""
        own = [dr.select(end, 1, REACH + p[a]) for a, end in enumerate(self.ends)]
        return [[1 - share, share] for share in own]

    def _slopes(self, axis: int, p: mi.Vector3f) -> list[_Slope]:
        """Along an axis: of the cells beyond the octant, and on its side."""
        planes = [self._plane(axis, step, p) for step in (-1, 0, 1)]
        return [planes[1].minus(planes[0]), planes[2].minus(planes[1])]

    def _plane(self, axis: int, step: int, p: mi.Vector3f) -> _Slope:
        """Values in the plane at `step`, at the other coordinates of p."""
        b, c = (axis + 1) % 3, (axis + 2) % 3
        f = []
        for j, i in product((0, 1), repeat=2):
            at = [0, 0, 0]
            at[axis], at[b], at[c] = step, i, j
            f.append(self.values[at[0], at[1], at[2]])
        near, far = f[1] - f[0], f[3] - f[2]
        low, high = dr.lerp(f[0], f[1], p[b]), dr.lerp(f[2], f[3], p[b])
        return _Slope(dr.lerp(low, high, p[c]), dr.lerp(near, far, p[c]), high - low)


@dataclass
class _Slope:
    """A number, and how it changes along the two axes that follow its own in the cycle X, Y, Z."""

    value: mi.Float
    first: mi.Float
    second: mi.Float

    def minus(self, other: _Slope) -> _Slope:
        return _Slope(self.value - other.value, self.first - other.first, self.second - other.second)


def _unit(s: mi.Vector3f) -> mi.Vector3f:
    length = dr.norm(s)
    return dr.select(length > 0, s / dr.select(length > 0, length, 1), 0)
