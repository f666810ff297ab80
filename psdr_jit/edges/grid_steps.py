"""Does radiance step at the creases of a grid? Where Mitsuba shades it with the normals of its cells, which a grid does
not tell. It is looked up at some points.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.memory import Memory, Slot
from ..core.sdf_cell import across_face
from ..core.surface_code import set_surface
from .grid_rows import CREASE
from .grid_set import GridRows, GridSet, cells_of

#: Creases of each grid that are looked at.
SAMPLES = 256

#: Of an integrator: grids, and by grid what was found.
STEPPED: Slot[tuple[tuple[mi.Shape, ...], list[bool]] | None] = Slot(lambda: None)

#: Length of the vector between shading normal and surface normal up to which they are the same: rounding is less.
ALIKE = 1e-3


def stepped_grids(grids: GridSet, memory: Memory) -> list[bool]:
    """By grid: is it shaded with the normals of its cells? Looked up once per scene."""
    shapes = tuple(place.shape for place in grids.places)
    known = memory[STEPPED]
    if known is None or [id(shape) for shape in known[0]] != [id(shape) for shape in shapes]:
        known = (shapes, [bool(step) for step in _stepped(grids)])
        memory[STEPPED] = known
    return known[1]


def _stepped(grids: GridSet) -> mi.UInt32:
    steps = dr.full(mi.UInt32, 1, len(grids.places))
    creases = dr.compress(grids.rows.part == CREASE)
    count = dr.width(creases)
    if count == 0:
        return steps
    stride = max(1, count // (SAMPLES * len(grids.places)))
    chosen = dr.gather(mi.UInt32, creases, dr.arange(mi.UInt32, count // stride) * stride)
    rows = dr.gather(GridRows, grids.rows, chosen)
    everywhere = mi.Bool(True)
    layers = grids.layers(rows, everywhere)
    s = rows.start + 0.5 * rows.length
    p = mi.Vector3f(s, across_face(layers[1], s)[0], 0)
    frame = grids.frame(rows, everywhere)
    n = dr.normalize(frame.gradient(cells_of(layers)[1].gradient(p)))
    x = frame.to_world(p)
    ray = mi.Ray3f(x + n, -n)
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(x))
    pi.valid, pi.t = mi.Bool(True), mi.Float(1)
    set_surface(pi, dr.gather(mi.UInt32, grids.code, rows.grid))
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    dr.scatter(steps, mi.UInt32(0), rows.grid, dr.norm(si.sh_frame.n - si.n) > ALIKE)
    return steps
