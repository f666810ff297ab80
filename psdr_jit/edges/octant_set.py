"""Octants of grids of signed distances on the device: their rows, their places, and the values around them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.sdf_octant import Octant
from ..core.upload import uploaded
from ..scene.grids import VALUES
from .grid_octants import OctantPieces, octant_pieces
from .grid_set import Frame, GridSet
from .octant_curve import Patch

#: Of an integrator: the grids that were looked at last, and their rows.
KNOWN: Slot[list[tuple[GridSet, OctantRows]]] = Slot(list)


@dataclass
class OctantRows:
    """`OctantPieces` on the device, and which grid they are of; detached."""

    grid: mi.UInt32  # index into the places
    corner: mi.Vector3u
    axis: mi.Vector3u
    sign: mi.Vector3f
    rises: mi.Float
    moves: mi.Bool


def octant_frame(grids: GridSet, rows: OctantRows, active: mi.Bool) -> Frame:
    """From the grid point of an octant, along its axes, in units of cells."""
    return grids.frame_at(rows.grid, mi.Vector3f(rows.corner), list(rows.axis), active, list(rows.sign))


def along_grid(rows: OctantRows, v: mi.Vector3f) -> mi.Vector3f:
    """A vector in coordinates of the octant along the axes of its grid, in the same units."""
    x, y, z = _directions(rows)
    return x * v[0] + y * v[1] + z * v[2]


def _directions(rows: OctantRows) -> list[mi.Vector3f]:
    """X, Y and Z as steps of the grid."""
    return [mi.Vector3f(*(dr.select(rows.axis[k] == a, rows.sign[k], 0) for a in range(3))) for k in range(3)]


def octant_rows(grids: GridSet, chosen: list[int], memory: Memory) -> OctantRows:
    """Of the grids with these numbers, kept while the grids rest."""
    known = memory[KNOWN]
    if not known or known[0][0] is not grids:
        known[:] = [(grids, _rows(grids, chosen))]
    return known[0][1]


def _rows(grids: GridSet, chosen: list[int]) -> OctantRows:
    pieces, number, known = [], [], {}
    for k in chosen:
        shape = grids.places[k].shape
        if id(shape) not in known:
            known[id(shape)] = octant_pieces(np.array(dr.detach(mi.traverse(shape)[VALUES]))[..., 0])
        pieces.append(known[id(shape)])
        number.append(np.full(len(pieces[-1].rises), k))
    p, grid = OctantPieces.joined(pieces), np.concatenate(number)
    moves = np.array([place.facts.moves for place in grids.places])[grid]
    vectors = [mi.Vector3u(*(uploaded(mi.UInt32, a[:, i]) for i in range(3))) for a in (p.corner, p.axis)]
    sign = mi.Vector3f(*(uploaded(mi.Float, p.sign[:, i]) for i in range(3)))
    grid = uploaded(mi.UInt32, grid)
    return OctantRows(grid, *vectors, sign, uploaded(mi.Float, p.rises), uploaded(mi.Bool, moves))


def octant_patch(grids: GridSet, rows: OctantRows, active: mi.Bool, values: mi.Float | None = None) -> Patch:
    """The octants of rows, with the 27 values about them; `values`: of a single grid, in place of the set's own."""
    size = dr.select(active, dr.gather(mi.UInt32, grids.size, rows.grid, active), 2)
    first = mi.UInt32(0)
    if values is None:
        values, first = grids.values, dr.gather(mi.UInt32, grids.first, rows.grid, active)
    along = [mi.Vector3i(d) for d in _directions(rows)]
    return Patch.of(Octant.around(values, first, size, mi.Vector3i(rows.corner), along, active), rows.rises)
