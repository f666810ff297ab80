"""Cones of directions, such as those in which a ball is seen, and mixtures of them: to draw from, with densities.

A cone is told by 1 − cos of its half angle: seen from a thousand radii away, the cosine itself is 1 but for rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Cone:
    """Directions within an angle of an axis; detached."""

    axis: mi.Vector3f
    open: mi.Float  # 1 − cos of the angle; 2: all directions

    @property
    def share(self) -> mi.Float:
        """Of all directions."""
        return self.open / 2

    @property
    def density(self) -> mi.Float:
        """1 / its solid angle."""
        return dr.inv_two_pi / self.open

    def sample(self, u: mi.Point2f) -> mi.Vector3f:
        rise = u.x * self.open
        sin, cos = dr.sincos(dr.two_pi * u.y)
        radius = dr.safe_sqrt(rise * (2 - rise))
        return mi.Frame3f(self.axis).to_world(mi.Vector3f(radius * cos, radius * sin, 1 - rise))

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        inside = (self.open > 0) & (dr.squared_norm(d - self.axis) / 2 <= self.open)
        return dr.select(inside, self.density, 0)

    def meets(self, other: Cone) -> mi.Bool:
        """Do they have directions in common?"""
        a, b = self.open, other.open
        cos_sum = (1 - a) * (1 - b) - dr.safe_sqrt(a * (2 - a) * b * (2 - b))
        return (a + b >= 2) | (dr.dot(self.axis, other.axis) > cos_sum)

    @staticmethod
    def none() -> Cone:
        """No directions."""
        return Cone(mi.Vector3f(0, 0, 1), mi.Float(0))


@dataclass(frozen=True)
class Cones:
    """Directions in any of some cones, each chosen with its odds: the density is the mean of theirs. Host object."""

    cones: tuple[Cone, ...]
    odds: tuple[mi.Float, ...]  # 0 of a cone without directions

    @staticmethod
    def by_angle(cones: Sequence[Cone]) -> Cones:
        """Each as likely as it is wide."""
        return Cones(tuple(cones), tuple(c.open for c in cones))

    @staticmethod
    def of_groups(groups: Sequence[Cones]) -> Cones:
        """Each of several groups as likely as the others, unless it is empty."""
        odds = [dr.select(g.total > 0, o / g.total, 0) for g in groups for o in g.odds]
        return Cones(tuple(c for g in groups for c in g.cones), tuple(odds))

    @property
    def total(self) -> mi.Float:
        """Sum of the odds; 0: there are no directions."""
        return sum(self.odds)

    @property
    def share(self) -> mi.Float:
        """Of all directions, overlaps counted as often as they are."""
        return sum(c.share for c in self.cones)

    def sample(self, u: mi.Point2f) -> mi.Vector3f:
        x, d, end = u.x * self.total, mi.Vector3f(0, 0, 1), mi.Float(0)
        for cone, odds in zip(self.cones, self.odds, strict=True):
            place = dr.clip((x - end) / odds, 0, 1)
            d = dr.select((odds > 0) & (x >= end), cone.sample(mi.Point2f(place, u.y)), d)
            end = end + odds
        return d

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        found = sum(odds * cone.pdf(d) for cone, odds in zip(self.cones, self.odds, strict=True))
        return dr.select(found > 0, found / self.total, 0)


def towards_sphere(x: mi.Point3f, centre: mi.Point3f, radius: mi.Float) -> Cone:
    """Directions from x to a ball; all of them from inside."""
    offset = mi.Vector3f(centre - x)
    dist2 = dr.squared_norm(offset)
    sin2 = dr.square(radius) / dist2
    outside = sin2 < 1
    axis = dr.select(outside, offset * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1))
    return Cone(axis, dr.select(outside, sin2 / (1 + dr.safe_sqrt(1 - sin2)), 2))
