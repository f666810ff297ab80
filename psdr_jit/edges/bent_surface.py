"""Surfaces with bump or normal maps, cut into patches: where points of them are, and how normals are bent there.

On a patch (a row of `BentRows`) a point is given by b in the unit triangle. The map may bend the normal many times on
the way across. Derivatives of the bent normal are differences.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import towards_viewer
from ..scene.bent_normals import BentMap
from ..scene.poses import Poses
from .bent_rows import BentRows
from .bent_texels import Texels
from .curves import transform_point
from .kind_pattern import FAR_SIDE
from .surface_points import Surface, SurfacePoint, point_of_body, point_of_face, surface_point

#: Step for differences, in units of b per texel.
DIFFERENCE = 2e-2

#: Change of h across a patch where there is none, as on flat ground below a map of one colour. There h does not depend
#: on the place but on ω alone: such curves move where ω turns, by n·ω̇/|∇h|, and count with |∇h|, whatever it is.
LEAST_GRADIENT = 1e-6

#: False positions of a root.
STEPS = 12


@dataclass
class Bent:
    """Normals at a point of a surface."""

    x: mi.Point3f  # [m]
    n: mi.Normal3f  # bent, unit
    n_s: mi.Normal3f  # not bent, unit

    def seen_from(self, side: mi.Float, mirrored: mi.Bool) -> mi.Normal3f:
        """The bent normal as the surface has it towards the side of n_s that this number's sign says."""
        back = mi.Normal3f(self.n - 2 * dr.dot(self.n, self.n_s) * self.n_s)
        return mi.Normal3f(dr.select(mirrored & (side < 0), back, self.n))


@dataclass
class PatchPoint:
    """A point of a patch, with derivatives by b1 and b2. Detached."""

    x: mi.Point3f  # [m]
    dx: tuple[mi.Vector3f, mi.Vector3f]
    n: mi.Normal3f  # bent, as it is towards one side
    dn: tuple[mi.Vector3f, mi.Vector3f]
    n_g: mi.Normal3f  # unit, of the surface itself

    @property
    def density(self) -> mi.Float:
        """|∂_1 x × ∂_2 x|: area per area of b [m²]."""
        return dr.norm(dr.cross(*self.dx))

    @property
    def size(self) -> mi.Float:
        """Of the patch [m]."""
        return dr.maximum(*(dr.norm(d) for d in self.dx))

    def barycentric(self, v: mi.Vector3f) -> mi.Vector2f:
        """How b changes along a vector in the surface."""
        a, b = self._dual
        return mi.Vector2f(dr.dot(a, v), dr.dot(b, v))

    def gradient(self, ω: mi.Vector3f) -> mi.Vector3f:
        """∇h of h = n·ω within the surface, for a fixed ω [1/m]. Not 0: see `LEAST_GRADIENT`."""
        a, b = self._dual
        m = dr.dot(self.dn[0], ω) * a + dr.dot(self.dn[1], ω) * b
        return dr.select(dr.squared_norm(m) > 0, m, LEAST_GRADIENT * a)

    def gradient_from(self, ω: mi.Vector3f, r: mi.Float) -> mi.Vector3f:
        """The same as seen from a viewpoint at the distance r, from which ω turns by dx/r across itself."""
        return self.gradient(ω) + (self.n - self.n_g * dr.dot(self.n_g, self.n)) / r

    @property
    def _dual(self) -> tuple[mi.Vector3f, mi.Vector3f]:
        n = dr.cross(*self.dx)
        scale = dr.rcp(dr.squared_norm(n))
        return dr.cross(self.dx[1], n) * scale, dr.cross(n, self.dx[0]) * scale


@dataclass(frozen=True)
class BentSurface(ABC):
    """Surfaces of one sort. Detached unless said otherwise; `rows` are those of the lanes."""

    bulge: ClassVar[float] = 0.0  # cosine by which a patch may face a viewer farther than its corners do

    maps: tuple[BentMap, ...]  # by BentRows.map
    pointers: mi.ShapePtr  # by BentRows.shape
    shapes: tuple[mi.Shape, ...]

    @abstractmethod
    def place(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        """The point with the surface's own coordinates `q`."""

    @abstractmethod
    def met(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        """How a ray meets it there, from no distance."""

    @abstractmethod
    def normal(self, rows: BentRows, at: SurfacePoint) -> mi.Normal3f:
        """Of the surface itself, unit: of its front, by which `BentRows.front` goes."""

    @abstractmethod
    def flat_normal(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> mi.Normal3f:
        """The same of flat faces, 0 elsewhere."""

    def bent(self, rows: BentRows, b: mi.Point2f, active: mi.Bool) -> Bent:
        return self._bent(rows, b, active, mi.RayFlags.All)

    def bent_at(self, rows: BentRows, places: Sequence[mi.Point2f], active: mi.Bool) -> list[Bent]:
        """The same at several places, one after the other: compiled once."""
        count = len(places)

        def goes_on(k: mi.UInt32, *found: Bent) -> mi.Bool:
            return active & (k < count)

        def step(k: mi.UInt32, *found: Bent) -> tuple:
            b = mi.Point2f(places[0])
            for number, place in enumerate(places[1:], 1):
                b = dr.select(k == number, place, b)
            here = self.bent(rows, mi.Point2f(b), active)
            return k + 1, *(dr.select(k == number, here, known) for number, known in enumerate(found))

        width = dr.width(rows.part, *places)
        state = (dr.zeros(mi.UInt32, width), *(dr.zeros(Bent, width) for _ in places))
        return list(dr.while_loop(state, goes_on, step, label="bent normals")[1:])

    def attached_bent(self, rows: BentRows, b: mi.Point2f, active: mi.Bool) -> Bent:
        """Of the material point; attached to shapes and maps. Normals are of about unit length."""
        return self._bent(rows, b, active, mi.RayFlags.All | mi.RayFlags.FollowShape)

    def _bent(self, rows: BentRows, b: mi.Point2f, active: mi.Bool, flags) -> Bent:
        ray, pi = self.met(rows, rows.q(b), active)
        si = pi.compute_surface_interaction(ray, flags, active)
        n = mi.Normal3f(0, 0, 1)
        for k, bent in enumerate(self.maps):
            mine = active & (rows.map == k)
            n = dr.select(mine, bent.normal(si, mine), n)
        return Bent(si.p, mi.Normal3f(si.to_world(n)), si.sh_frame.n)

    def at(self, rows: BentRows, b: mi.Point2f, side: mi.Float, active: mi.Bool) -> PatchPoint:
        """The point b as it is seen from a side of n_s, with derivatives on its own texel."""
        step = DIFFERENCE / dr.maximum(rows.texels, 1)
        texels, steps = Texels.of(rows), []
        for way in (mi.Vector2f(1, 0), mi.Vector2f(0, 1)):
            same = dr.all(dr.floor(texels.of_point(b)) == dr.floor(texels.of_point(mi.Point2f(b + step * way))))
            steps.append(dr.select(same, step, -step))
        places = [b, mi.Point2f(b + mi.Vector2f(steps[0], 0)), mi.Point2f(b + mi.Vector2f(0, steps[1]))]
        n, *others = (bent.seen_from(side, rows.mirrored) for bent in self.bent_at(rows, places, active))
        dn = [mi.Vector3f(other - n) / step for other, step in zip(others, steps, strict=True)]
        place = self.place(rows, rows.q(b), active)
        dx = place.towards(rows.q1 - rows.q0), place.towards(rows.q2 - rows.q0)
        return PatchPoint(place.x, dx, n, (dn[0], dn[1]), self.normal(rows, place))

    def height(self, rows: BentRows, bent: Bent, view: mi.Vector4f) -> mi.Float:
        """Cosine between the bent normal and the direction to the viewer."""
        towards = towards_viewer(view, bent.x)
        side = self.side_seen(rows, bent, towards)
        return dr.dot(bent.seen_from(side, rows.mirrored), towards) / dr.norm(towards)

    def side_seen(self, rows: BentRows, bent: Bent, towards: mi.Vector3f) -> mi.Float:
        """Which side of n_s is seen from there: ±1."""
        return dr.select(dr.dot(bent.n_s, towards) < 0, mi.Float(-1), 1)

    def turns_away(
        self, rows: BentRows, start: mi.Point2f, along: mi.Vector2f, h: tuple, view: mi.Vector4f, active: mi.Bool
    ) -> mi.Float:
        """At which share of the way from `start` to `start + along` bent normals turn from a viewpoint. `h`: height at
        both ends, of different sign; how large it is there need not be exact.

        By false positions; an end that stays for the second time counts half (the Illinois method).
        """

        def goes_on(low, high, h_low, h_high, r, h, stayed, k):
            return active & (k < STEPS) & (dr.abs(h) > dr.epsilon(mi.Float))

        def step(low, high, h_low, h_high, r, h, stayed, k):
            r = (low * h_high - high * h_low) / (h_high - h_low)
            h = self.height(rows, self.bent(rows, mi.Point2f(start + r * along), active), view)
            before = (h > 0) == (h_low > 0)
            end = dr.select(before, mi.Float(1), -1)  # which one stays
            less = dr.select(end == stayed, mi.Float(0.5), 1)
            h_low, h_high = dr.select(before, h, h_low * less), dr.select(before, h_high * less, h)
            return dr.select(before, r, low), dr.select(before, high, r), h_low, h_high, r, h, end, k + 1

        zero, one = mi.Float(0), mi.Float(1)
        state = (zero, one, *h, mi.Float(0), mi.Float(1), mi.Float(0), mi.UInt32(0))
        return dr.while_loop(state, goes_on, step, label="bent normals turn away")[4]


@dataclass(frozen=True)
class BentMeshes(BentSurface):
    """Faces of meshes; q are barycentric coordinates (b1, b2), as Mitsuba's `prim_uv`."""

    positions: mi.Point3f  # of all vertices, detached

    def place(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        return point_of_face(self.positions, rows, q, active)

    def met(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        return mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)), _hit(self.pointers, rows, rows.part, q, active)

    def normal(self, rows: BentRows, at: SurfacePoint) -> mi.Normal3f:
        return at.normal

    def flat_normal(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> mi.Normal3f:
        return self.normal(rows, self.place(rows, q, active))


@dataclass(frozen=True)
class BentBodies(BentSurface):
    """Disks, cylinders and spheres; q are their texture coordinates."""

    bulge: ClassVar[float] = FAR_SIDE

    @cached_property
    def poses(self) -> Poses:
        return Poses.of(self.shapes)

    def place(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        return point_of_body(self.poses, rows, q)

    def met(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        local = surface_point(rows.part, q)[0]
        x = transform_point(self.poses.at(rows.shape), local)
        pi = _hit(self.pointers, rows, mi.UInt32(0), mi.Point2f(local.x, local.y), active)
        return mi.Ray3f(x, mi.Vector3f(0, 0, 1)), pi

    def normal(self, rows: BentRows, at: SurfacePoint) -> mi.Normal3f:
        """Outwards: on a sphere, texture coordinates lead around the other way."""
        outward = dr.select(rows.part == int(Surface.SPHERE), -1.0, 1.0)
        return mi.Normal3f(at.normal * outward)

    def flat_normal(self, rows: BentRows, q: mi.Point2f, active: mi.Bool) -> mi.Normal3f:
        return mi.Normal3f(0)

    def side_seen(self, rows: BentRows, bent: Bent, towards: mi.Vector3f) -> mi.Float:
        """Of a ball that is seen from outside only, the outer one, also behind its rim: a curve next to the rim has
        another next to it there, and h the same sign on most of its patch, if the back counts as mirrored.
        """
        outwards = dr.sign(dr.dot(bent.n_s, bent.x - mi.Point3f(self.poses.at(rows.shape)[3])))
        return dr.select(rows.back, super().side_seen(rows, bent, towards), outwards)


def _hit(pointers: mi.ShapePtr, rows: BentRows, prim: mi.UInt32, uv: mi.Point2f, active: mi.Bool):
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.valid = active
    pi.t = dr.select(active, mi.Float(0), dr.inf)
    pi.prim_index, pi.prim_uv = prim, uv
    pi.shape = dr.gather(mi.ShapePtr, pointers, rows.shape, active)
    return pi
