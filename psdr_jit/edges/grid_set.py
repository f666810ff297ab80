"""The grids of signed distances of a scene on the device: their values, their places, and the cells around an edge."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.sdf_cell import Cell
from ..core.surface_code import INSTANCED, PART_SHIFT, parts_are_shapes, registry_index
from ..core.upload import uploaded
from ..scene.grids import VALUES
from .edge_shapes import GridPlace
from .grid_rows import GridPieces, grid_pieces

#: Steps of Newton's method from a point within a cell of the surface onto it.
NEWTON_STEPS = 2


@dataclass
class GridRows:
    """`GridPieces` on the device, and which grid they are of; detached."""

    grid: mi.UInt32  # index into the places
    part: mi.UInt32
    base: mi.UInt32  # index into the values of all grids
    x: mi.UInt32
    y: mi.UInt32
    z: mi.UInt32
    low: mi.Bool
    high: mi.Bool
    root: mi.Float
    start: mi.Float
    length: mi.Float
    weight: mi.Float
    moves: mi.Bool


@dataclass
class Frame:
    """Where a cell is in the world: x = origin + X axes[0] + Y axes[1] + Z axes[2]; detached."""

    origin: mi.Point3f
    axes: list[mi.Vector3f]  # [m]
    duals: list[mi.Vector3f]  # gradients of X, Y and Z
    corner: mi.Vector3f  # the point (0, 0, 0) of the cell in units of cells, along the axes of the grid
    axis: list[mi.UInt32]  # X, Y and Z as axes of the grid

    def to_world(self, p: mi.Vector3f) -> mi.Point3f:
        return mi.Point3f(self.origin + self.vector(p))

    def vector(self, v: mi.Vector3f) -> mi.Vector3f:
        return v.x * self.axes[0] + v.y * self.axes[1] + v.z * self.axes[2]

    def gradient(self, g: mi.Vector3f) -> mi.Vector3f:
        return g.x * self.duals[0] + g.y * self.duals[1] + g.z * self.duals[2]

    def direction(self, d: mi.Vector3f) -> mi.Vector3f:
        """A direction of the world in coordinates of the cell."""
        return mi.Vector3f(*(dr.dot(d, dual) for dual in self.duals))

    def point(self, x: mi.Point3f) -> mi.Vector3f:
        return self.direction(mi.Vector3f(x - self.origin))

    def view(self, view: mi.Vector4f) -> mi.Vector4f:
        """A homogeneous viewpoint in coordinates of the cell."""
        v = self.direction(mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(self.origin))
        return mi.Vector4f(v.x, v.y, v.z, view.w)


@dataclass(frozen=True)
class GridSet:
    """Grids, one after the other; detached."""

    places: tuple[GridPlace, ...]
    rows: GridRows
    values: mi.Float  # of all of them
    first: mi.UInt32  # by grid: its first value ...
    size: mi.UInt32  # ... how many there are along an axis ...
    code: mi.UInt32  # ... its `surface_code` ...
    columns: tuple[mi.Vector3f, ...]  # ... axes and origin in the world, of the unit cube ...
    inverse: tuple[mi.Vector3f, ...]  # ... and the gradients of its three coordinates

    def frame(self, rows: GridRows, active: mi.Bool) -> Frame:
        """The cell of rows: of a face, that above it."""
        size = dr.select(active, dr.gather(mi.UInt32, self.size, rows.grid, active), 2)
        k = rows.base - dr.gather(mi.UInt32, self.first, rows.grid, active)
        corner = mi.Vector3f(k % size, (k // size) % size, k // (size * size))
        return self.frame_at(rows.grid, corner, [rows.x, rows.y, rows.z], active)

    def frame_at(
        self, grid: mi.UInt32, corner: mi.Vector3f, axis: list[mi.UInt32], active: mi.Bool, sign=(1.0, 1.0, 1.0)
    ) -> Frame:
        """From the point `corner` of a grid, along its axes `axis`; `sign`: ±1, up them or down."""
        columns = [dr.gather(mi.Vector3f, c, grid, active) for c in self.columns]
        inverse = [dr.gather(mi.Vector3f, c, grid, active) for c in self.inverse]
        cells = mi.Float(dr.select(active, dr.gather(mi.UInt32, self.size, grid, active), 2) - 1)
        return Frame(
            origin=mi.Point3f(columns[3] + sum(columns[a] * corner[a] for a in range(3)) / cells),
            axes=[_picked(columns, a) * s / cells for a, s in zip(axis, sign, strict=True)],
            duals=[_picked(inverse, a) * s * cells for a, s in zip(axis, sign, strict=True)],
            corner=corner,
            axis=axis,
        )

    def layers(self, rows: GridRows, active: mi.Bool, values: mi.Float | None = None) -> list[list[mi.Float]]:
        """Values in the plane of a face, and one cell below and above it: `[below, on, above]`, of four each.

        `values`: those to read in place of this set's own.
        """
        size = dr.select(active, dr.gather(mi.UInt32, self.size, rows.grid, active), 2)
        sx, sy, sz = (dr.select(a == 0, 1, dr.select(a == 1, size, size * size)) for a in (rows.x, rows.y, rows.z))
        there = [rows.low & (rows.part != 0), mi.Bool(True), rows.high]
        found = []
        for step, exists in zip((mi.UInt32(0) - sz, mi.UInt32(0), sz), there, strict=True):
            at = rows.base + dr.select(exists, step, 0)
            corners = [at, at + sx, at + sy, at + sx + sy]
            found.append([dr.gather(mi.Float, self.values if values is None else values, i, active) for i in corners])
        return found

    def field(self, grid: mi.UInt32, x: mi.Point3f, active: mi.Bool) -> tuple[mi.Float, mi.Vector3f]:
        """`(f, ∇f)` of a grid at a point of the world, in whatever cell it is."""
        cell, p, duals = self._cell_at(grid, x, active)
        g = cell.gradient(p)
        return cell.value(p), g.x * duals[0] + g.y * duals[1] + g.z * duals[2]

    def onto(self, grid: mi.UInt32, x: mi.Point3f, active: mi.Bool) -> mi.Point3f:
        """The point of the surface near x, by Newton's method along ∇f."""
        for _ in range(NEWTON_STEPS):
            f, g = self.field(grid, x, active)
            x = x - f / dr.maximum(dr.squared_norm(g), dr.smallest(mi.Float)) * g
        return x

    def local(self, grid: mi.UInt32, x: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, list[mi.Vector3f]]:
        """A point in units of cells, and the gradients of its coordinates."""
        origin = dr.gather(mi.Vector3f, self.columns[3], grid, active)
        inverse = [dr.gather(mi.Vector3f, i, grid, active) for i in self.inverse]
        cells = mi.Float(dr.select(active, dr.gather(mi.UInt32, self.size, grid, active), 2) - 1)
        q = mi.Vector3f(*(dr.dot(mi.Vector3f(x) - origin, i) * cells for i in inverse))
        return q, [mi.Vector3f(i * cells) for i in inverse]

    def bend(self, grid: mi.UInt32, x: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """How ∇f changes per unit of length along d, in the cell that x is in."""
        cell, p, duals = self._cell_at(grid, x, active)
        h = cell.bend(p, mi.Vector3f(*(dr.dot(dual, d) for dual in duals)))
        return h.x * duals[0] + h.y * duals[1] + h.z * duals[2]

    def _cell_at(
        self, grid: mi.UInt32, x: mi.Point3f, active: mi.Bool
    ) -> tuple[Cell, mi.Vector3f, list[mi.Vector3f]]:
        """The cell around a point of the world, the point in its coordinates, and the gradients of these."""
        q, duals = self.local(grid, x, active)
        size = dr.select(active, dr.gather(mi.UInt32, self.size, grid, active), 2)
        q = dr.clip(q, 0, mi.Float(size - 1))
        corner = [dr.minimum(mi.UInt32(a), size - 2) for a in q]
        at = dr.gather(mi.UInt32, self.first, grid, active) + corner[0] + size * (corner[1] + size * corner[2])
        corners = [at + i + size * j for j in (0, 1) for i in (0, 1)]
        f = [[dr.gather(mi.Float, self.values, c + size * size * k, active) for c in corners] for k in (0, 1)]
        p = mi.Vector3f(*(a - mi.Float(c) for a, c in zip(q, corner, strict=True)))
        return Cell(*f), p, duals


def grid_set(places: tuple[GridPlace, ...]) -> GridSet | None:
    """The grids at `places`, read anew; None if there are none."""
    if not places:
        return None
    values, pieces, first, size, columns, inverse = [], [], [], [], [], []
    known: dict[int, tuple[np.ndarray, GridPieces]] = {}  # grids that several instances show
    for place in places:
        if id(place.shape) not in known:
            grid = np.array(dr.detach(mi.traverse(place.shape)[VALUES]))[..., 0]
            known[id(place.shape)] = (grid, grid_pieces(grid))
        grid, found = known[id(place.shape)]
        first.append(sum(v.size for v in values))
        values.append(grid.ravel())
        size.append(grid.shape[0])
        pieces.append(found)
        matrix = place.to_world()
        columns.append(matrix[:3].T)
        inverse.append(np.linalg.inv(matrix[:3, :3]))
    return GridSet(
        places,
        _rows(places, pieces, first),
        uploaded(mi.Float, np.concatenate(values)),
        uploaded(mi.UInt32, np.array(first)),
        uploaded(mi.UInt32, np.array(size)),
        uploaded(mi.UInt32, np.array([_code(place) for place in places])),
        _vectors(np.stack(columns)),
        _vectors(np.stack(inverse)),
    )


def _code(place: GridPlace) -> int:
    own = registry_index(place.shape)
    if place.instance is None:
        return own
    part = own if parts_are_shapes() else place.place
    return INSTANCED | (part << PART_SHIFT) | registry_index(place.instance)


def _vectors(table: np.ndarray) -> tuple[mi.Vector3f, ...]:
    """(grids, K, 3) as K arrays of vectors."""
    parts = range(table.shape[1])
    return tuple(mi.Vector3f(*(uploaded(mi.Float, table[:, k, i]) for i in range(3))) for k in parts)


def _rows(places: tuple[GridPlace, ...], pieces: list[GridPieces], first: list[int]) -> GridRows:
    number = np.concatenate([np.full(len(p.base), k) for k, p in enumerate(pieces)])
    p = GridPieces.joined(pieces)
    ints = (number, p.part, p.base + np.array(first)[number], p.x, p.y, p.z)
    moves = np.array([place.facts.moves for place in places])[number]
    return GridRows(
        *(uploaded(mi.UInt32, a) for a in ints),
        *(uploaded(mi.Bool, a) for a in (p.low, p.high)),
        *(uploaded(mi.Float, a) for a in (p.root, p.start, p.length, p.weight)),
        uploaded(mi.Bool, moves),
    )


def _picked(vectors: list[mi.Vector3f], axis: mi.UInt32) -> mi.Vector3f:
    return dr.select(axis == 0, vectors[0], dr.select(axis == 1, vectors[1], vectors[2]))


def cells_of(layers: list[list[mi.Float]]) -> tuple[Cell, Cell]:
    """The cells below and above a face; of an outline, its own is the second."""
    below, on, above = layers
    return Cell(below, on), Cell(on, above)
