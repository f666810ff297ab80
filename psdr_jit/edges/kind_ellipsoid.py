"""Outlines of ellipsoids (`core.ellipsoid`). Where ellipsoids cut into each other is not looked for."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ellipsoid import Ellipsoid
from ..core.memory import Memory
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..scene.names import shown_name
from ..scene.surfaces import Ellipsoids
from .kind import ContourKind, OnEdge, Side, Sight, Use
from .location import EdgeLocation
from .overlaps import crossing
from .points import clearance

#: Rows of an outline: hidden or distant parts get their own weight.
PIECES = 8

#: Steps off an outline in units of the smallest half axis, clear of how exactly Mitsuba meets ellipsoids.
ASIDE = 6e-3

#: By how much the surface is looked at inside of its outline, on the unit sphere.
TURN = 1e-3

#: Ellipsoids of one shape up to which their pairs are looked at; of more, some overlap.
MOST_PAIRED = 1000


@dataclass(frozen=True)
class EllipsoidOutlines(ContourKind):
    """Row k is a piece of the outline of ellipsoid k // PIECES."""

    bodies: Ellipsoids
    centre: mi.Point3f  # of the scene

    @property
    def count(self) -> int:
        return dr.width(self.bodies.first) * PIECES

    def _rows(self) -> mi.UInt32:
        return dr.arange(mi.UInt32, self.count)

    def _body(self, row: mi.UInt32, active: mi.Bool) -> Ellipsoid:
        return self.bodies.ellipsoid(row // PIECES, active)

    def moving(self) -> mi.Bool:
        owner = dr.gather(mi.UInt32, self.bodies.owner, self._rows() // PIECES)
        moves = dr.zeros(mi.Bool, self.count)
        for k, moving in enumerate(self.bodies.moves):
            moves |= (owner == k) & moving
        return moves

    def places(self) -> mi.Point3f:
        return self.inside(self._rows(), mi.Bool(True))

    def inside(self, row: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        return mi.Point3f(dr.detach(self._body(row, active).c))

    def line_weights(self, use: Use) -> mi.Float:
        s = dr.detach(self._body(self._rows(), mi.Bool(True)).s)
        return dr.two_pi * dr.pi / PIECES * dr.mean(dr.abs(s))

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f, active: mi.Bool) -> OnEdge:
        body = self._body(row, active)
        m, dm, valid = body.outline(view, (mi.Float(row % PIECES) + t) / PIECES)
        x = body.point(m)
        offset, lead = clearance(x, body.size, self.centre)
        offset = dr.maximum(offset, ASIDE * body.size)
        dx = body.vector(dm) / PIECES
        return OnEdge(x, dx, body.normal(m), mi.Point3f(m), body.size, offset, lead, offset, active & valid)

    def aim(self, row: mi.UInt32, sight: Sight, active: mi.Bool) -> mi.Point3f:
        """A ray aimed at a tangent point meets the ellipsoid itself: beside it."""
        return sight.at.x + sight.offset * sight.n_perp

    def side(self, row: mi.UInt32, sight: Sight, which: mi.UInt32, active: mi.Bool) -> Side:
        """The ellipsoid itself on the side −n_perp, and whatever a ray meets on the other."""
        body, index = self._body(row, active), row // PIECES
        ω = dr.normalize(body.on_sphere(sight.ω))
        x = body.point(dr.normalize(mi.Vector3f(sight.at.local) - TURN * ω))
        return Side.of_segment(self.bodies, index, mi.Point3f(x), sight, which, (which == 0) & active)

    def displacement(self, row: mi.UInt32, at: EdgeLocation, ω: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """That of a material point, which keeps its place on the unit sphere."""
        x = self._body(row, active).point(dr.detach(mi.Vector3f(at.local)))
        return dr.select(active, mi.Vector3f(x - dr.detach(x)), 0)


def warn_about_touching(bodies: Ellipsoids, memory: Memory) -> None:
    """Name shapes whose ellipsoids may cut into each other, as their boxes overlap, once each."""
    count = dr.width(bodies.first)
    body = bodies.ellipsoid(dr.arange(mi.UInt32, count), mi.Bool(True))
    columns = [body.vector(mi.Vector3f(*(float(k == axis) for k in range(3)))) for axis in range(3)]
    reach = mi.Vector3f(*(dr.sqrt(sum(dr.square(column[k]) for column in columns)) for k in range(3)))
    c, r, owner = np.array(dr.detach(body.c)).T, np.array(dr.detach(reach)).T, np.array(bodies.owner)
    for k, shape in enumerate(bodies.shapes):
        own = np.flatnonzero(owner == k)
        if len(own) > MOST_PAIRED or crossing([np.stack([c[i] - r[i], c[i] + r[i]]) for i in own]):
            warn_once(
                f"ellipsoids of shape '{shown_name(shape)}' may cut into each other: the curves where they meet are "
                "not found, and outlines inside of others count; keep them apart, or use meshes",
                UnsupportedWarning,
                memory,
            )
