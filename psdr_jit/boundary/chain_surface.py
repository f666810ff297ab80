"""Are two hits on the same surface? Yes if a continuous path on it leads from the one to the other.

The same plane where shapes are flat; elsewhere the same shape met from the same side, in front of its face and of its
shading normal, unless one point lies far off the other's tangent plane for their distance (a surface in front of
itself) or their normals differ (a crease), which spheres, cylinders and single triangles know nothing of. Such a guess
may be wrong for rays that are far apart, which costs time, and is right for those close by, which is what counts.

What particles carry on from faces with interpolated normals steps between these by Veach's correction, which knows
of the faces (`folds`), though what is seen does not.

Where normals are interpolated, a direction ω may lead away from the surface by the shading normal n_s, and under it by
the face's normal n. Such a path goes on behind the surface that it is reflected by. Where that begins, at n·ω = 0 or on
the edge to a face that is tilted otherwise, what is seen steps: a horizon of the face.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edges.copy_table import CopyTable, number_of, values_of_shapes
from ..edges.edge_shapes import edge_shapes
from ..plan.job import Job
from .chain_grids import ChainGrids

#: Flat surfaces: largest sine of the angle between planes that count as one, and their distance relative to the ray's.
COPLANAR_SINE, COPLANAR_OFFSET = 2e-4, 1e-4

#: Plugins of shapes that bulge everywhere: they cannot hide a part of themselves.
ROUND = ("sphere", "cylinder")

#: Curved surfaces: offset of one point from the tangent plane of the other, relative to their distance, and difference
#: of the normals from which on they count as apart.
STEP_SLOPE, STEP_NORMAL = 0.25, 0.3

#: Length of the difference of unit normals up to which faces are one plane: a few times their rounding.
ONE_NORMAL = 2e-6

#: The same up to which they share an edge: surfaces do not cut there, and hardly step.
ONE_SHADING = 1e-2

#: No guess of where chains part.
NOWHERE = -1.0


@dataclass(frozen=True)
class ChainSurfaces:
    """What is to be known of a scene's shapes. Host object."""

    copies: CopyTable | None  # of what instances show: shapes as the tables below know them
    flat: mi.UInt32  # by registry index of a shape: 1 if its faces are shaded as planes
    loose: mi.UInt32  # the same: 1 if rays meet it next to a contour with any normal
    round: mi.UInt32  # the same: 1 if what is met of it from one side is one surface, however far apart
    horizons: bool  # are there shading normals?
    grids: ChainGrids | None = None
    folds: bool = False  # do paths part, too, on edges between faces across which normals are interpolated?

    @staticmethod
    def of(job: Job) -> ChainSurfaces:
        shapes = edge_shapes(job).facts
        flat = {s.index for s in shapes if (s.is_mesh and not s.smooth) or s.plugin == "disk"}
        bulging = {s.index for s in shapes if s.plugin in ROUND}
        loose = {s.index for s in job.facts.shapes if s.kind in ("curve", "grid") and s.index >= 0}
        tables = (values_of_shapes(job, dict.fromkeys(indices, 1)) for indices in (flat, loose, bulging))
        return ChainSurfaces(CopyTable.of(job), *tables, any(s.smooth for s in shapes), ChainGrids.of(job))

    def is_flat(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Is it a point of a shape whose faces are shaded as planes?"""
        return _listed(self.flat, number_of(self.copies, si), active)

    def same(self, a, b, d_a: mi.Vector3f, d_b: mi.Vector3f, k: mi.UInt32) -> mi.Bool:
        """Do two rays of directions d, segments `k` of their paths, end on one surface, or both escape? `a`, `b`:
        surface interactions.
        """
        both = a.is_valid() & b.is_valid()
        number = number_of(self.copies, a)
        same = (number == number_of(self.copies, b)) & (a.is_valid() == b.is_valid())
        flat = _listed(self.flat, number, both & same)
        offset = b.p - a.p
        # not `> 0`: meshes in the wild have normals that are 0 or not numbers, and no side of theirs differs
        side = ~(dr.dot(a.n, d_a) * dr.dot(b.n, d_b) < 0)
        one_face = a.shape.is_mesh() & (a.prim_index == b.prim_index)
        near = COPLANAR_OFFSET * (a.t + b.t)
        one_plane = (dr.norm(dr.cross(a.n, b.n)) < COPLANAR_SINE) & (dr.dot(a.n, b.n) > 0)
        one_plane &= dr.abs(dr.dot(a.n, offset)) < near
        one_plane |= one_face
        n_a, n_b = a.sh_frame.n, b.sh_frame.n
        off = dr.maximum(dr.abs(dr.dot(n_a, offset)), dr.abs(dr.dot(n_b, offset)))
        shaded = ~(dr.dot(n_a, d_a) * dr.dot(n_b, d_b) < 0)
        close = (off < STEP_SLOPE * dr.norm(offset) + near) & (dr.norm(n_a - n_b) < STEP_NORMAL)
        if self.folds:
            close &= (k == 0) | ~a.shape.is_mesh() | (dr.norm(a.n - b.n) < ONE_NORMAL)
        if self.grids is not None:
            close &= ~self.grids.bends(number, a.n, b.n) | ~self.grids.step_between(number, a.p, b.p)
        loose = _listed(self.loose, number, both & same)
        shaded |= loose if self.grids is None else loose & ~self.grids.blends(number)
        one_curve = (loose | side) & shaded & (one_face | close | _listed(self.round, number, both & same))
        return same & (~both | dr.select(flat, one_plane & side, one_curve))


def _listed(table: mi.UInt32, number: mi.UInt32, active: mi.Bool | bool) -> mi.Bool:
    """Is the shape with this registry index marked in a table of `ChainSurfaces`?"""
    return dr.gather(mi.UInt32, table, number, active) != 0


def goes_under(si: mi.SurfaceInteraction3f, ω: mi.Vector3f) -> mi.Bool:
    """Does the direction ω lead to one side by the face's normal, and to the other one by the shading normal?"""
    return dr.dot(si.n, ω) * dr.dot(si.sh_frame.n, ω) < 0
