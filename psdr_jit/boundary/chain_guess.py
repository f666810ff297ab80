"""Roughly where between two neighbouring chains the place lies at which they part.

From the one to the other the last lines of sight change almost evenly, and so does what tells on which side of a curve
they pass: of a side A B of a triangle d·((B − A) × (o − A)), of the contour of a sphere or tube and of the rim of a
disk the distance, of two planes the difference of their distances along the line, of a shading outline n·d, of the
choice of a lobe the number that chooses, less the probability of the first. Where such a function changes its sign, its
zero is guessed at on a straight line. A surface that ends does so at the curve that is crossed first, from the hit; the
nearer of the two is looked at before the other. A wrong guess costs the search a comparison (`chain_search`), no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..edges.copy_table import CopyTable
from ..paths.surface_at import surface_of
from ..scene.surfaces import Surfaces
from .chain_outline import SIDES, AnalyticShapes, triangle
from .chain_patterns import NO_FAMILY
from .chain_surface import NOWHERE
from .chain_trace import Pair


def _zero(f: mi.Float, g: mi.Float) -> mi.Float:
    """Share of the way at which what is f at the start and g at the end is 0; infinite where signs agree."""
    return dr.select(f * g < 0, f / (f - g), dr.inf)


def _past_sides(on_mesh: mi.Bool, x: Sequence[mi.Point3f], line: Hit, other: Hit) -> mi.Float:
    """Share of the way from `line`, which meets the triangle, to `other` at which it is left; infinite: it is not."""
    found = mi.Float(dr.inf)
    for i, j in SIDES:
        f, g = (dr.dot(ray.d, dr.cross(x[j] - x[i], ray.o - x[i])) for ray in (line, other))
        found = dr.minimum(found, _zero(f, g))
    return dr.select(on_mesh, found, dr.inf)


def _past_round(shapes: AnalyticShapes, hit: Hit, other: Hit, active: mi.Bool) -> mi.Float:
    """The same of spheres, tubes and disks."""
    shape = shapes.met_by(hit, active)

    def beyond(ray: Hit) -> mi.Float:
        """How far the line passes outside of the contour, or of the disk; in local units."""
        o, d = shape.local(ray.o, 1), shape.local(ray.d, 0)
        on_disk = o - d * (o.z / d.z)
        return dr.norm(dr.select(shape.disk, on_disk, shape.closest(o, d)) * shape.across) - 1

    return dr.select(shape.there, _zero(beyond(hit), beyond(other)), dr.inf)


def _across_planes(near: tuple, far: tuple, a: Hit, b: Hit) -> mi.Float:
    """Share of the way from a to b at which two triangles' planes are equally far away."""

    def ahead(ray: Hit) -> mi.Float:
        distances = []
        for _, x in (near, far):
            n = dr.cross(x[1] - x[0], x[2] - x[0])
            distances.append(dr.dot(n, x[0] - ray.o) / dr.dot(n, ray.d))
        return distances[0] - distances[1]

    return dr.select(near[0] & far[0], _zero(ahead(a), ahead(b)), dr.inf)


@dataclass(frozen=True)
class Guesses:
    """What is asked of where chains part. Host object."""

    analytic: AnalyticShapes | None
    copies: CopyTable | None  # of what instances show
    tables: Surfaces | None  # what Mitsuba does not evaluate
    smooth: bool  # are there surfaces with shading normals?

    def where(self, pair: Pair, active: mi.Bool) -> mi.Float:
        """Share of the way from a to b, or `NOWHERE`. Detached."""
        outlined = active & (pair.family == NO_FAMILY) & ~pair.horizon & ~pair.turned & ~pair.chosen
        first = pair.a.intersection().t <= pair.b.intersection().t
        near, far = dr.select(first, pair.a, pair.b), dr.select(first, pair.b, pair.a)
        of_near, of_far = (triangle(self.copies, hit, outlined) for hit in (near, far))
        s = _past_sides(*of_near, near, far)
        t = _past_sides(*of_far, far, near)
        if self.analytic is not None:
            s = dr.minimum(s, _past_round(self.analytic, near, far, outlined))
            t = dr.minimum(t, _past_round(self.analytic, far, near, outlined))
        s, t = dr.select(first, s, 1 - s), dr.select(first, 1 - t, t)
        s = dr.select(dr.isfinite(s), s, t)
        s = dr.select(dr.isfinite(s), s, _across_planes(of_near, of_far, pair.a, pair.b))
        if self.smooth:
            same = outlined & (pair.a.shape == pair.b.shape) & (pair.a.shape != 0)
            h = [self._turned(hit, same) for hit in (pair.a, pair.b)]
            turned = _zero(*h)
            s = dr.select(same & dr.isfinite(turned), turned, s)
        s = dr.select(outlined, s, pair.where)
        return dr.select(active & dr.isfinite(s), s, NOWHERE)

    def place(self, pair: Pair, start: mi.Float, end: mi.Float, active: mi.Bool) -> mi.Float:
        """The same of chains from the places `start` and `end`, as a place between these."""
        share = self.where(pair, active)
        return dr.select(share >= 0, start + share * (end - start), NOWHERE)

    def _turned(self, hit: Hit, active: mi.Bool) -> mi.Float:
        """n·d of the shading normal."""
        si = surface_of(self.tables, hit, active)
        return dr.dot(si.sh_frame.n, hit.d)
