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

from ..plan.job import Job
from ..scene.registry import registry_table

#: Flat surfaces: largest sine of the angle between planes that count as one, and their distance relative to the ray's.
COPLANAR_SINE, COPLANAR_OFFSET = 2e-4, 1e-4

#: Plugins of shapes that bulge everywhere: they cannot hide a part of themselves.
ROUND = ("sphere", "cylinder")

#: Curved surfaces: offset of one point from the tangent plane of the other, relative to their distance, and difference
#: of the normals from which on they count as apart.
STEP_SLOPE, STEP_NORMAL = 0.25, 0.3

#: Length of the difference of unit normals up to which faces are one plane: a few times their rounding.
ONE_NORMAL = 2e-6

#: No guess of where chains part.
NOWHERE = -1.0


@dataclass(frozen=True)
class ChainSurfaces:
    """What is to be known of a scene's shapes. Host object."""

    flat: mi.UInt32  # by registry index of a shape: 1 if its faces are shaded as planes
    round: mi.UInt32  # the same: 1 if what is met of it from one side is one surface, however far apart
    horizons: bool  # are there shading normals?
    folds: bool = False  # do paths part, too, on edges between faces across which normals are interpolated?

    @staticmethod
    def of(job: Job) -> ChainSurfaces:
        shapes = job.facts.shapes
        flat = {s.index for s in shapes if (s.is_mesh and not s.smooth) or s.plugin == "disk"}
        bulging = {s.index for s in shapes if s.plugin in ROUND}
        tables = (registry_table(job.scene, indices) for indices in (flat, bulging))
        return ChainSurfaces(*tables, any(s.smooth for s in shapes))

    def is_flat(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Is it a point of a shape whose faces are shaded as planes?"""
        return _listed(self.flat, si, active)

    def same(self, a, b, d_a: mi.Vector3f, d_b: mi.Vector3f, k: mi.UInt32) -> mi.Bool:
        """Do two rays of directions d, segments `k` of their paths, end on one surface, or both escape? `a`, `b`:
        surface interactions.
        """
        both = a.is_valid() & b.is_valid()
        same = (a.shape == b.shape) & (a.is_valid() == b.is_valid())
        flat = self.is_flat(a, both & same)
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
        one_curve = side & shaded & (one_face | close | _listed(self.round, a, both & same))
        return same & (~both | dr.select(flat, one_plane & side, one_curve))


def _listed(table: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool | bool) -> mi.Bool:
    """Is the shape that was met marked in a table of `ChainSurfaces`?"""
    index = dr.select(active & si.is_valid(), dr.reinterpret_array(mi.UInt32, si.shape), 0)
    return dr.gather(mi.UInt32, table, index) != 0


def goes_under(si: mi.SurfaceInteraction3f, ω: mi.Vector3f) -> mi.Bool:
    """Does the direction ω lead to one side by the face's normal, and to the other one by the shading normal?"""
    return dr.dot(si.n, ω) * dr.dot(si.sh_frame.n, ω) < 0
