"""How the surface of a grid moves: with the place of the grid, and with its values.

A point p of the surface f(p) = 0 moves by M(p) with the map of the grid into the world, and by −δf / |∇f| along the
normal with the values. A curve on a face stays on the surface and on the face, which only M moves.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.grids import TO_WORLD, VALUES
from .grid_rows import OUTLINE
from .grid_set import Frame, GridRows, GridSet, cells_of

#: Least sin² of the angle between surface and face that counts: where both are one, the edge does not move across it.
ALIGNED = 1e-6


def surface_motion(
    grids: GridSet, rows: GridRows, frame: Frame, p: mi.Vector3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float, mi.Vector3f]:
    """`(n, displacement along it, that with the place of the grid)` at p, the latter two attached, of value 0."""
    with dr.suspend_grad():
        below, above = cells_of(grids.layers(rows, active))
        in_cell = (rows.part == OUTLINE) | rows.high
        under = p + mi.Vector3f(0, 0, 1)
        g = frame.gradient(dr.select(in_cell, above.gradient(p), below.gradient(under)))
        slope = dr.norm(g)
        n = g / slope
    moved, rigid = mi.Float(0), mi.Vector3f(0)
    for k, place in enumerate(grids.places):
        params = mi.traverse(place.shape) if place.facts.moves else None
        mine = active & (rows.grid == k)
        if params is not None and dr.grad_enabled(params[TO_WORLD].matrix):
            world = params[TO_WORLD] @ _unit_point(grids, rows, frame, p, mine)
            rigid = dr.select(mine, world - dr.detach(world), rigid)
        if params is not None and dr.grad_enabled(params[VALUES]):
            f = _value(grids, k, params[VALUES].array, rows, p, in_cell, mine)
            moved = dr.select(mine, (dr.detach(f) - f) / slope, moved)
    return n, moved + dr.dot(n, rigid), rigid


def _unit_point(grids: GridSet, rows: GridRows, frame: Frame, p: mi.Vector3f, active: mi.Bool) -> mi.Point3f:
    """The point p of a cell in the coordinates of its grid, [0, 1]³; detached."""
    with dr.suspend_grad():
        cells = dr.select(active, dr.gather(mi.UInt32, grids.size, rows.grid, active), 2) - 1
        found = mi.Point3f(frame.corner)
        for axis, value in zip(frame.axis, (p.x, p.y, p.z), strict=True):
            found += mi.Point3f(*(dr.select(axis == k, value, 0) for k in range(3)))
        return found / mi.Float(cells)


def _value(
    grids: GridSet, k: int, values: mi.Float, rows: GridRows, p: mi.Vector3f, in_cell: mi.Bool, active: mi.Bool
) -> mi.Float:
    """f at p of the grid number k, attached to its `values`."""
    own = GridRows(**{name: getattr(rows, name) for name in rows.__dataclass_fields__})
    own.base = rows.base - dr.gather(mi.UInt32, grids.first, rows.grid, active)
    below, above = cells_of(grids.layers(own, active, mi.Float(values)))
    return dr.select(in_cell, above.value(p), below.value(p + mi.Vector3f(0, 0, 1)))


def crease_motion(frame: Frame, n: mi.Vector3f, moved: mi.Float, rigid: mi.Vector3f) -> mi.Vector3f:
    """Displacement d with n·d = `moved` that stays on the face, m·d = m·`rigid`: across the edge, attached."""
    m = dr.normalize(frame.duals[2])
    cos, along = dr.dot(n, m), dr.dot(m, rigid)
    room = 1 - dr.square(cos)
    return dr.select(room > ALIGNED, (n * (moved - cos * along) + m * (along - cos * moved)) / room, 0)
