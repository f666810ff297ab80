"""What surfaces with bump or normal maps are like at a few places of a triangle, and what of it curves cross there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import towards_viewer
from .bent_rows import BentRows
from .bent_surface import Bent, BentSurface

#: Where on a triangle its weights look: at its corners, which it has in common with others, but for rounding, and
#: between them. `ASIDE`: from corner to corner, in b.
INSET = 1e-3
ASIDE = 1 - 3 * INSET
LOOKED_AT = tuple((INSET + ASIDE * b1, INSET + ASIDE * b2)
                  for b1, b2 in ((0, 0), (1, 0), (0, 1), (0.5, 0.5), (0, 0.5), (0.5, 0)))  # fmt: skip

#: The four triangles between these places.
QUARTERS = ((0, 4, 5), (1, 3, 5), (2, 3, 4), (3, 4, 5))

#: Share of the weight of a triangle that no curve was seen to cross: where h comes as close to 0 as it changes between
#: the places, and elsewhere.
POSSIBLE, UNLIKELY = 0.15, 0.01

#: Radiance steps by about this, relative to itself, per sine by which a normal is bent: it is turned over.
STEP_PER_SINE = 2.0


@dataclass
class Corners:
    """Triangles on patches, one per lane, in b."""

    b0: mi.Point2f
    b1: mi.Point2f
    b2: mi.Point2f

    def at(self, b: mi.Point2f) -> mi.Point2f:
        return mi.Point2f(self.b0 + b.x * (self.b1 - self.b0) + b.y * (self.b2 - self.b0))

    def within(self, part: Corners) -> Corners:
        """A part of the triangles, given in their own coordinates."""
        return Corners(self.at(part.b0), self.at(part.b1), self.at(part.b2))


def whole_patch() -> Corners:
    return Corners(mi.Point2f(0, 0), mi.Point2f(1, 0), mi.Point2f(0, 1))


@dataclass(frozen=True)
class Looks:
    """Of triangles, one entry each, where they are `LOOKED_AT`; detached."""

    at: list[Bent]
    mirrored: mi.Bool

    @staticmethod
    def of(surface: BentSurface, rows: BentRows, corners: Corners) -> Looks:
        """`rows`: one for each triangle."""
        places = [corners.at(mi.Point2f(*place)) for place in LOOKED_AT]
        return Looks(surface.bent_at(rows, places, mi.Bool(True)), rows.mirrored)

    @cached_property
    def sines(self) -> list[mi.Float]:
        """Of the angle by which normals are bent."""
        return [dr.norm(dr.cross(look.n, look.n_s)) for look in self.at]

    @property
    def step(self) -> mi.Float:
        """By about how much of itself the radiance steps."""
        return sum(self.sines) * (STEP_PER_SINE / len(LOOKED_AT))

    def seen(self, eye: mi.Vector4f, slack: mi.Float) -> Seen:
        """From a viewpoint that is known up to `slack` [m]."""
        cos, h, reach = [], [], []
        for look in self.at:
            view = towards_viewer(eye, look.x)
            far = dr.norm(view)
            cos.append(dr.dot(look.n_s, view) / far)
            h.append(dr.dot(look.seen_from(cos[-1], self.mirrored), view) / far)
            reach.append(slack / far)
        return Seen(cos, h, most(reach))


@dataclass(frozen=True)
class Seen:
    """Triangles as they are seen where they are `LOOKED_AT`."""

    cos: list[mi.Float]  # between n_s and the direction to the viewer
    h: list[mi.Float]  # between the bent normal and this direction
    blur: mi.Float  # of both, as the viewpoint is not known

    def crossed(self) -> mi.Float:
        """About how much of a triangle is crossed by curves."""
        near = least([dr.abs(value) for value in self.h]) < most(self.h) - least(self.h)
        share = mi.Float(0)
        for quarter in QUARTERS:
            own = [self.h[k] for k in quarter]
            share += dr.select((least(own) <= self.blur) & (most(own) >= -self.blur), 1 / len(QUARTERS), 0)
        return dr.maximum(share, dr.select(near, mi.Float(POSSIBLE), UNLIKELY))


def least(values: list[mi.Float]) -> mi.Float:
    return reduce(dr.minimum, values)


def most(values: list[mi.Float]) -> mi.Float:
    return reduce(dr.maximum, values)
