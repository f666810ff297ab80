"""The surface of a grid of signed distances whose values move, attached (`scene.grids`).

A ray of moving origin and direction meets the surface f = 0 where it meets the tangent plane, which moves by −δf / |∇f|
along the normal with the values, and with the place of the grid. The normal is that of the cell there. For shading it
may be blended (`core.sdf_octant`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.sdf_cell import Cell
from ..core.sdf_octant import Octant
from ..scene.grids import TO_WORLD, VALUES, MovingGrid
from .own_surface import of_hit, on_ray, where_active


def grid_surface(
    grid: MovingGrid, pi: mi.PreliminaryIntersection3f, segment: mi.UInt32, ray: mi.Ray3f, follow: bool, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """The surface of `grid`; lanes that are not `active` hold anything finite. `follow`: the point moves with the
    surface, not along the ray.
    """
    o, d, t = where_active(ray, pi, active)
    params = mi.traverse(grid.shape)
    to_world, field = params[TO_WORLD], _Field(grid, mi.Float(params[VALUES].array), active)
    cells = mi.Float(grid.cells)
    x = mi.Point3f(dr.detach(o) + t * dr.detach(d))
    p = mi.Point3f(x)
    if dr.grad_enabled(o, d, to_world, field.values):
        q = dr.detach(to_world.inverse() @ x)
        cell, within = field.cell(q * cells)
        g = mi.Vector3f(dr.detach(to_world @ mi.Normal3f(cell.gradient(within) * cells)))
        slope = dr.norm(g)
        n, f = g / slope, cell.value(within)
        moved = to_world @ q - n * ((f - dr.detach(f)) / slope)
        p = mi.Point3f(moved) if follow else on_ray(o, d, t, n, moved)
        p = mi.Point3f(dr.replace_grad(x, p))
    q = (to_world.inverse() @ p) * cells
    cell, within = field.cell(q)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = p
    si.n = mi.Normal3f(dr.normalize(to_world @ mi.Normal3f(cell.gradient(within))))
    n_s = dr.normalize(to_world @ mi.Normal3f(field.blended(q))) if grid.blends else si.n
    si.sh_frame = mi.Frame3f(n_s)
    return of_hit(si, pi, ray, (o, d, t))


class _Field:
    """The values of a grid at points in units of cells, attached to both."""

    def __init__(self, grid: MovingGrid, values: mi.Float, active: mi.Bool):
        self.cells, self.values, self.active = grid.cells, values, active

    def _corners(self, q: mi.Point3f) -> list[mi.UInt32]:
        last = self.cells - 1
        return [dr.minimum(mi.UInt32(dr.maximum(dr.detach(a), 0)), last) for a in (q.x, q.y, q.z)]

    def cell(self, q: mi.Point3f) -> tuple[Cell, mi.Vector3f]:
        """The cell around q, and q in its coordinates."""
        corner, size = self._corners(q), self.cells + 1
        first = corner[0] + size * (corner[1] + size * corner[2])
        offsets = [first + i + size * j for j in (0, 1) for i in (0, 1)]
        layers = [[dr.gather(mi.Float, self.values, a + size * size * k, self.active) for a in offsets] for k in (0, 1)]
        within = mi.Vector3f(*(a - mi.Float(c) for a, c in zip((q.x, q.y, q.z), corner, strict=True)))
        return Cell(*layers), within

    def blended(self, q: mi.Point3f) -> mi.Vector3f:
        """Mitsuba's smooth normal, of any length."""
        middle = dr.round(dr.detach(mi.Vector3f(q)))
        sign = dr.select(dr.detach(mi.Vector3f(q)) >= middle, mi.Vector3f(1), -1)
        along = [mi.Vector3i(*(mi.Int32(sign[k]) if axis == k else 0 for axis in range(3))) for k in range(3)]
        octant = Octant.around(self.values, mi.UInt32(0), self.cells + 1, mi.Vector3i(middle), along, self.active)
        return octant.blended((mi.Vector3f(q) - middle) * sign) * sign
