"""The cells of SDF grids, as chains meet them: where surfaces bend, and where they end on the face of a cell.

A grid's surface is smooth within each cell of the grid, and bends between cells. If it is shaded with the normals of
the cells, what is seen steps there. With the normal n of the surface and that of the face, a, the bend runs along
n × a.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..edges.copy_table import shape_numbers
from ..edges.grid_set import GridSet
from ..edges.kind_grid import OFF
from ..edges.scene_grids import scene_grids
from ..plan.job import Job
from ..scene.grids import blends_normals
from ..scene.registry import values_by_registry

#: Length of the difference of unit normals below which a bend is too slight to matter.
SLIGHT = 1e-3

#: How far from the face of a cell, in cells, a hit is next to it.
NEXT_TO = 1e-3


@dataclass(frozen=True)
class ChainGrids:
    """The grids of a scene. Host object."""

    number: mi.UInt32  # by registry index of a shape: 1 + its place among the grids, 0: it is none
    grids: GridSet
    stepped: mi.UInt32  # by grid: 1 if it is shaded with the normals of cells

    @staticmethod
    def of(job: Job) -> ChainGrids | None:
        """None if there are none. What an instance shows of grids is not known here."""
        grids = scene_grids(job)
        if grids is None:
            return None
        codes = np.array(grids.code)
        number = values_by_registry({int(code): k + 1 for k, code in enumerate(codes)}, int(shape_numbers(job).max()))
        stepped = [not blends_normals(place.shape, job.call.memory) for place in grids.places]
        return ChainGrids(number, grids, uploaded(mi.UInt32, np.array(stepped)))

    def bends(self, shape: mi.UInt32, a: mi.Normal3f, b: mi.Normal3f) -> mi.Bool:
        """Are these normals of a grid so far apart that its surface bends, rather than curves, between close points?"""
        return self._grid(shape)[1] & (dr.norm(a - b) > SLIGHT)

    def step_between(self, shape: mi.UInt32, a: mi.Point3f, b: mi.Point3f) -> mi.Bool:
        """Do two points of one shape, by registry index, lie in different cells of a grid that shows its cells?"""
        grid, met = self._grid(shape)
        shown = met & (dr.gather(mi.UInt32, self.stepped, grid, met) != 0)
        cell_a, cell_b = (dr.floor(self.grids.local(grid, x, shown)[0]) for x in (a, b))
        return shown & dr.any(cell_a != cell_b)

    def side(self, shape: mi.UInt32, a, b, d: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """±1: does a line of sight along d move farther into the cell of `a`, off that of `b`, if it is shifted by ±n?

        `a`, `b`: what is seen on both sides of a bend. 0: they lie in one cell, or on no grid.
        """
        grid, met = self._grid(shape)
        (q_a, duals), (q_b, _) = (self.grids.local(grid, si.p, met) for si in (a, b))
        shifted = n - d * (dr.dot(a.n, n) / dr.dot(a.n, d))  # on the surface of a
        side = mi.Float(0)
        for axis in range(3):
            off = dr.floor(q_a[axis]) - dr.floor(q_b[axis])
            side = dr.select(off != 0, dr.sign(off) * dr.sign(dr.dot(duals[axis], shifted)), side)
        return dr.select(met, side, 0)

    def face(self, shape: mi.UInt32, x: mi.Point3f) -> tuple[mi.Vector3f, mi.Bool]:
        """`(normal, whether there is one)` of the face of a cell that a point of a shape is next to. Of any length."""
        grid, met = self._grid(shape)
        q, duals = self.grids.local(grid, x, met)
        away, a = mi.Float(NEXT_TO), mi.Vector3f(0)
        for axis in range(3):
            own = dr.abs(q[axis] - dr.round(q[axis]))
            a = dr.select(own < away, duals[axis], a)
            away = dr.minimum(away, own)
        return a, met & (away < NEXT_TO)

    def turn(self, shape: mi.UInt32, x: mi.Point3f, n: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Bool]:
        """`(e, is it a grid)`: within the surface, the direction in which its normal n turns as one goes along d."""
        grid, met = self._grid(shape)
        e = self.grids.bend(grid, x, d - dr.dot(n, d) * n, met)
        return e - dr.dot(n, e) * n, met

    def inside(self, shape: mi.UInt32, x: mi.Point3f, d: mi.Vector3f) -> mi.Vector3f:
        """From a point x next to an outline to where the surface is looked at: towards the viewer, along the surface.

        There, rays meet it with any normal.
        """
        grid, met = self._grid(shape)
        size = dr.rcp(dr.norm(self.grids.local(grid, x, met)[1][0]))
        y = self.grids.onto(grid, mi.Point3f(x - OFF * size * d), met)
        return dr.select(met, mi.Vector3f(y - x), 0)

    def blends(self, shape: mi.UInt32) -> mi.Bool:
        """Is it a grid that is shaded with blended normals? They turn away where the surface itself does not."""
        grid, met = self._grid(shape)
        return met & (dr.gather(mi.UInt32, self.stepped, grid, met) == 0)

    def _grid(self, shape: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
        number = dr.gather(mi.UInt32, self.number, shape)
        return dr.maximum(number, 1) - 1, number != 0
