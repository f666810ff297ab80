"""Grids of signed distances whose values move, and how grids are shaded.

Where its values are differentiated, Mitsuba's own attached surface of a grid is not used: it takes them for distances
in the unit cube, and moves along rays as if |∇f| were 1 (`paths.grid_surface` evaluates it anew).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.surface_code import registry_index
from ..core.upload import uploaded
from ..core.varying import varying
from .facts import SceneFacts

#: Parameters of a grid.
VALUES, TO_WORLD = "grid", "to_world"

#: Points of a grid that are looked at.
SAMPLES = 256

#: Angle between shading normal and surface normal up to which they are the same [degrees]: rounding is less.
ALIKE = 0.05

#: Share of these points at which the angle is less than the one that a grid is judged by.
SHARE = 0.9

#: Of an integrator: grids that have been looked at, kept alive, by their id; and how far their normals are bent.
LOOKED_AT: Slot[dict[int, tuple[mi.Shape, float]]] = Slot(dict)


@dataclass(frozen=True)
class MovingGrid:
    """A shape whose values are differentiated."""

    shape: mi.Shape
    number: mi.UInt32  # in the registry
    cells: mi.UInt32  # along an axis
    blends: bool  # is it shaded with normals blended between cells?

    def segment(self, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Number of what was met, which does not matter, and whether it is this grid."""
        return pi.prim_index, active & (dr.reinterpret_array(mi.UInt32, pi.shape) == self.number)


def moving_grids(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> list[MovingGrid]:
    """All grids of `scene` whose values move."""
    found = []
    for facts_of in facts.shapes:
        if facts_of.kind == "grid" and facts_of.index >= 0 and VALUES in facts_of.geometry:
            shape = scene.shapes()[facts_of.index]
            number = registry_index(shape)
            cells = mi.traverse(shape)[VALUES].shape[0] - 1
            found.append(
                MovingGrid(shape, varying(mi.UInt32, number), varying(mi.UInt32, cells), blends_normals(shape, memory))
            )
    return found


def blends_normals(shape: mi.Shape, memory: Memory) -> bool:
    """Is a grid shaded with normals blended between its cells? It does not tell; looked up once."""
    return bent_degrees(shape, memory) > ALIKE


def bent_degrees(shape: mi.Shape, memory: Memory) -> float:
    """Angle [degrees] between the shading normals of a grid and its surface, where its cells meet; looked up once."""
    known = memory[LOOKED_AT]
    if id(shape) not in known:
        with dr.suspend_grad():
            known[id(shape)] = (shape, _bent_degrees(shape))
    return known[id(shape)][1]


def _bent_degrees(shape: mi.Shape) -> float:
    """The angle at points between cells; 0 where there are none."""
    params = mi.traverse(shape)
    f = np.array(dr.detach(params[VALUES]))[..., 0].transpose(2, 1, 0)
    points = []
    for axis in range(3):
        a, b = (np.moveaxis(f, axis, 0)[k] for k in (slice(None, -1), slice(1, None)))
        where = np.argwhere(a * b < 0)
        share = a[tuple(where.T)] / (a[tuple(where.T)] - b[tuple(where.T)])
        on_edge = where.astype(float)
        on_edge[:, 0] += share
        points.append(np.insert(on_edge[:, 1:], axis, on_edge[:, 0], axis=1))
    points = np.concatenate(points) / (f.shape[0] - 1)
    points = points[:: max(1, len(points) // SAMPLES)]
    if len(points) == 0:
        return 0.0
    x = params[TO_WORLD] @ mi.Point3f(*(uploaded(mi.Float, points[:, k]) for k in range(3)))
    pi = dr.zeros(mi.PreliminaryIntersection3f, len(points))
    pi.valid, pi.t, pi.shape = mi.Bool(True), mi.Float(1), mi.ShapePtr(shape)
    towards = mi.Vector3f(0, 0, 1)
    si = pi.compute_surface_interaction(mi.Ray3f(x - towards, towards), mi.RayFlags.All)
    angle = 2 * np.degrees(np.arcsin(np.array(dr.norm(si.sh_frame.n - si.n)) / 2))
    angle = angle[np.isfinite(angle)]  # at the border of the grid there may be no normal
    return float(np.quantile(angle, SHARE)) if len(angle) else 0.0
