"""Octants of grids of signed distances on the device: their rows, their places, and the values around them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

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
    columns = [dr.gather(mi.Vector3f, c, rows.grid, active) for c in grids.columns]
    inverse = [dr.gather(mi.Vector3f, c, rows.grid, active) for c in grids.inverse]
    cells = mi.Float(dr.select(active, dr.gather(mi.UInt32, grids.size, rows.grid, active), 2) - 1)
    axis = [rows.axis.x, rows.axis.y, rows.axis.z]

    def picked(vectors: list[mi.Vector3f], k: int) -> mi.Vector3f:
        return dr.select(axis[k] == 0, vectors[0], dr.select(axis[k] == 1, vectors[1], vectors[2])) * rows.sign[k]

    corner = mi.Vector3f(rows.corner)
    return Frame(
        origin=mi.Point3f(columns[3] + sum(columns[a] * corner[a] for a in range(3)) / cells),
        axes=[picked(columns, k) / cells for k in range(3)],
        duals=[picked(inverse, k) * cells for k in range(3)],
        corner=corner,
        axis=axis,
    )


def along_grid(rows: OctantRows, v: mi.Vector3f) -> mi.Vector3f:
    """A vector in coordinates of the octant along the axes of its grid, in the same units."""
    along = [mi.Vector3f(*(dr.select(rows.axis[k] == a, rows.sign[k], 0) for a in range(3))) for k in range(3)]
    return along[0] * v[0] + along[1] * v[1] + along[2] * v[2]


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
    first = 0 if values is not None else dr.gather(mi.UInt32, grids.first, rows.grid, active)
    values = grids.values if values is None else values
    last, found = mi.Int32(size) - 1, {}
    for step in product((-1, 0, 1), repeat=3):
        at = [mi.Int32(0)] * 3
        for k in range(3):
            moved = mi.Int32(rows.sign[k]) * step[k]
            for axis in range(3):
                at[axis] = at[axis] + dr.select(rows.axis[k] == axis, moved, 0)
        at = [dr.clip(mi.Int32(rows.corner[axis]) + at[axis], 0, last) for axis in range(3)]
        index = first + mi.UInt32(at[0]) + size * (mi.UInt32(at[1]) + size * mi.UInt32(at[2]))
        found[step] = dr.gather(mi.Float, values, index, active)
    ends = []
    for k in range(3):
        own = sum(dr.select(rows.axis[k] == axis, rows.corner[axis], 0) for axis in range(3))
        ends.append((rows.sign[k] > 0) & (own == 0))
    return Patch.of(Octant(found, ends), rows.rises)
