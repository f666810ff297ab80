"""The surfaces that are evaluated here: curves and other bodies as tables, and in scenes of meshes all of them.

Of a curve, the tables say which segment a ray has met, and its control points. Mitsuba's own attached evaluation of
curves is not used. Of B-splines, its points do not stay on the surface where circles twist, and at the very end of a
shape it reads past its segments; of linear curves, it has none. What is here is enough to evaluate them anew
(`core.tube_axis`, `core.rod`, `paths.surface_at`, `paths.rod_surface`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import CONTROL_POINTS
from ..core.ellipsoid import Ellipsoid
from ..core.joining import joined, pointers
from ..core.memory import Memory
from ..core.rod import Rod
from ..core.tube_axis import Axis
from ..core.upload import uploaded
from .facts import SceneFacts, ShapeFacts
from .grids import TO_WORLD, MovingGrid, moving_grids
from .mesh_tables import MeshTables, mesh_tables
from .registry import registry_indices, registry_table

T = TypeVar("T", bound="Segments")

#: Parameter of ellipsoids, and how many numbers describe one of them.
ELLIPSOID_DATA, ELLIPSOID_SIZE = "data", 10

#: Of a shape that is no such curve.
NONE = 0xFFFFFFFF


@dataclass(frozen=True)
class Segments:
    """All curves of one plugin, one after the other. Host object; the arrays are detached."""

    shapes: tuple[mi.Shape, ...]
    pointers: mi.ShapePtr  # to them
    moves: tuple[bool, ...]  # by shape
    start: mi.UInt32  # by registry index of a shape: its first segment, or `NONE`
    count: mi.UInt32  # likewise: how many segments it has
    first: mi.UInt32  # by segment: its first control point ...
    owner: mi.UInt32  # ... and its shape
    offsets: tuple[int, ...]  # by shape: its first control point
    points: mi.Float  # (x, y, z, radius) of all control points, flat

    def segment(self, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Which segment was met, and whether it was one at all."""
        start = dr.gather(mi.UInt32, self.start, dr.reinterpret_array(mi.UInt32, pi.shape), active)
        met = active & (start != NONE)
        return start + pi.prim_index, met

    def pointer(self, segment: mi.UInt32, active: mi.Bool) -> mi.ShapePtr:
        """The shape of segments."""
        return dr.gather(mi.ShapePtr, self.pointers, dr.gather(mi.UInt32, self.owner, segment, active), active)

    def prim_index(self, segment: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The number of segments within their shape."""
        shape = dr.reinterpret_array(mi.UInt32, self.pointer(segment, active))
        return segment - dr.gather(mi.UInt32, self.start, shape, active)

    def control_points(self, segment: mi.UInt32, number: int, active: mi.Bool) -> list[mi.Vector4f]:
        """The first `number` control points of segments; attached to those whose gradients are enabled."""
        first = dr.gather(mi.UInt32, self.first, segment, active)
        p = [dr.gather(mi.Vector4f, self.points, first + k, active) for k in range(number)]
        if any(self.moves):
            owner = dr.gather(mi.UInt32, self.owner, segment, active)
            for k, (shape, offset) in enumerate(zip(self.shapes, self.offsets, strict=True)):
                flat = mi.traverse(shape)[CONTROL_POINTS] if self.moves[k] else None
                if flat is not None and dr.grad_enabled(flat):
                    mine = active & (owner == k)
                    # from each shape's own array: a gradient does not leave a loop through a concatenation
                    own = [dr.gather(mi.Vector4f, flat, first - offset + j, mine) for j in range(number)]
                    p = [dr.select(mine, a, b) for a, b in zip(own, p, strict=True)]
        return p


class Splines(Segments):
    """B-spline curves."""

    def axis(self, segment: mi.UInt32, v: mi.Float, active: mi.Bool) -> Axis:
        """The axis at v of segments, attached as their control points are."""
        return Axis.of(self.control_points(segment, 4, active), v)

    def ends(self, segment: mi.UInt32, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Does a curve begin with these segments, does it end with them? Of one, control points follow each other."""
        last = dr.width(self.first) - 1
        own = dr.gather(mi.UInt32, self.first, segment, active)
        before = dr.gather(mi.UInt32, self.first, dr.maximum(segment, 1) - 1, active)
        after = dr.gather(mi.UInt32, self.first, dr.minimum(segment + 1, last), active)
        return active & ((segment == 0) | (before + 1 != own)), active & ((segment == last) | (own + 1 != after))


class Rods(Segments):
    """Linear curves."""

    def rod(self, segment: mi.UInt32, active: mi.Bool) -> Rod:
        """Segments, attached as their control points are."""
        return Rod.between(*self.control_points(segment, 2, active))


@dataclass(frozen=True)
class Ellipsoids(Segments):
    """Ellipsoids: a "segment" is one of them, and its control points are the ten numbers that describe it."""

    extent: mi.Float  # by shape: factor on the half axes

    def ellipsoid(self, index: mi.UInt32, active: mi.Bool) -> Ellipsoid:
        """Attached as their data are."""
        first = dr.gather(mi.UInt32, self.first, index, active) * ELLIPSOID_SIZE
        owner = dr.gather(mi.UInt32, self.owner, index, active)
        data = [dr.gather(mi.Float, self.points, first + k, active) for k in range(ELLIPSOID_SIZE)]
        for k, (shape, offset) in enumerate(zip(self.shapes, self.offsets, strict=True)):
            flat = mi.traverse(shape)[ELLIPSOID_DATA] if self.moves[k] else None
            if flat is not None and dr.grad_enabled(flat):
                mine = active & (owner == k)
                own = [dr.gather(mi.Float, flat, first - offset * ELLIPSOID_SIZE + j, mine) for j in range(10)]
                data = [dr.select(mine, a, b) for a, b in zip(own, data, strict=True)]
        return Ellipsoid.of(data, dr.gather(mi.Float, self.extent, owner, active))


@dataclass(frozen=True)
class Cylinders:
    """Cylinders: which shapes they are."""

    moving: tuple[mi.Shape, ...]  # those with a pose that is differentiated
    among: mi.UInt32  # by registry index of a shape: 1 if it is one

    def segment(self, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Number of what was met, which does not matter, and whether it is one of them."""
        shape = dr.reinterpret_array(mi.UInt32, pi.shape)
        return pi.prim_index, active & (dr.gather(mi.UInt32, self.among, shape, active) != 0)

    def attached(self) -> bool:
        """Does one of them move, here and now?"""
        return any(dr.grad_enabled(mi.traverse(shape)[TO_WORLD]) for shape in self.moving)


@dataclass(frozen=True)
class Surfaces:
    """The curves of a scene, and what else has a surface that is not Mitsuba's to evaluate."""

    splines: Splines | None
    rods: Rods | None
    grids: list[MovingGrid]
    ellipsoids: Ellipsoids | None
    cylinders: Cylinders | None
    meshes: MeshTables | None = None  # and spheres, where there is nothing else


def surfaces_of(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> Surfaces | None:
    """The curves, cylinders and moving grids of `scene`, or its meshes and spheres; None if Mitsuba evaluates all."""
    meshes = mesh_tables(scene, memory)
    if meshes is not None:
        return Surfaces(None, None, [], None, None, meshes)
    curves = [s for s in facts.shapes if s.kind == "curve" and s.index >= 0]
    grids = moving_grids(scene, facts, memory)
    ellipsoids = [s for s in facts.shapes if s.kind == "ellipsoids" and s.index >= 0]
    cylinders = [s for s in facts.shapes if s.plugin == "cylinder" and s.index >= 0]
    if not curves and not grids and not ellipsoids and not cylinders:
        return None
    of = {plugin: [s for s in curves if s.plugin == plugin] for plugin in ("bsplinecurve", "linearcurve")}
    return Surfaces(_table(Splines, scene, of["bsplinecurve"]), _table(Rods, scene, of["linearcurve"]), grids,
                 _table(Ellipsoids, scene, ellipsoids), _cylinders(scene, cylinders))  # fmt: skip


def _cylinders(scene: mi.Scene, chosen: list[ShapeFacts]) -> Cylinders | None:
    """The shapes `chosen`; None if there are none."""
    if not chosen:
        return None
    moving = tuple(scene.shapes()[s.index] for s in chosen if s.moves)
    return Cylinders(moving, registry_table(scene, {s.index for s in chosen}))


def _table(family: type[T], scene: mi.Scene, chosen: list[ShapeFacts]) -> T | None:
    """The shapes `chosen`; None if there are none."""
    if not chosen:
        return None
    shapes = [scene.shapes()[s.index] for s in chosen]
    ids = registry_indices(scene)
    start, count = (np.full(max(ids) + 1, value, np.uint32) for value in (NONE, 1))
    first, owner, offsets, points, segments = [], [], [], [], 0
    for k, (facts_of, shape) in enumerate(zip(chosen, shapes, strict=True)):
        params = mi.traverse(shape)
        if family is Ellipsoids:
            stride, of_shape = ELLIPSOID_SIZE, params[ELLIPSOID_DATA]
            own = np.arange(dr.width(of_shape) // stride, dtype=np.uint32)
        else:
            stride, of_shape = 4, params[CONTROL_POINTS]
            own = np.array(params["segment_indices"], np.uint32)
        offsets.append(sum(dr.width(p) for p in points) // stride)
        points.append(dr.detach(of_shape))
        first.append(own + offsets[-1])
        owner.append(np.full(len(own), k))
        start[ids[facts_of.index]], count[ids[facts_of.index]] = segments, len(own)
        segments += len(own)
    flat = joined(points)
    dr.eval(flat)
    tables = [uploaded(mi.UInt32, np.concatenate(a)) for a in (first, owner)]
    moves = tuple(s.moves for s in chosen)
    extents = [np.array([mi.traverse(shape)["extent"] for shape in shapes])] if family is Ellipsoids else []
    return family(tuple(shapes), pointers(mi.ShapePtr, shapes), moves, uploaded(mi.UInt32, start),
                  uploaded(mi.UInt32, count), *tables, tuple(offsets), flat,
                  *(uploaded(mi.Float, a) for a in extents))  # fmt: skip
