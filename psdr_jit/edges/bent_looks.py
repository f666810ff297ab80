"""What surfaces with bump or normal maps are like at a few places of a patch, and what of it curves cross there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import towards_viewer
from .bent_rows import BentRows
from .bent_surface import Bent, BentSurface

#: How far inside of what is looked at its corners are looked at, which it has in common with others, in its own size.
INSET = 1e-3
ASIDE = 1 - 3 * INSET  # from corner to corner of a triangle


@dataclass(frozen=True)
class Places:
    """Where something is looked at, in its own coordinates, and the triangles between these places."""

    places: tuple[tuple[float, float], ...]
    triangles: tuple[tuple[int, int, int], ...]


ON_TRIANGLE = Places(
    tuple((INSET + ASIDE * b1, INSET + ASIDE * b2)
          for b1, b2 in ((0, 0), (1, 0), (0, 1), (0.5, 0.5), (0, 0.5), (0.5, 0))),
    ((0, 4, 5), (1, 3, 5), (2, 3, 4), (3, 4, 5)),
)  # fmt: skip

IN_RECTANGLE = Places(
    tuple((INSET + (1 - 2 * INSET) * x, INSET + (1 - 2 * INSET) * y)
          for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0.5))),
    ((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
)  # fmt: skip

#: Share of the weight of what no curve was seen to cross: where h comes as close to 0 as it changes between the places,
#: and elsewhere.
POSSIBLE, UNLIKELY = 0.15, 0.01

#: Radiance steps by about this, relative to itself, per sine by which a normal is bent: it is turned over.
STEP_PER_SINE = 2.0


@dataclass(frozen=True)
class Looks:
    """Of patches or parts of them, one entry each; detached."""

    at: list[Bent]
    mirrored: mi.Bool
    triangles: tuple[tuple[int, int, int], ...]  # between the places

    @staticmethod
    def of(surface: BentSurface, rows: BentRows, b: list[mi.Point2f], where: Places) -> Looks:
        """`rows`, `b`: one for each part; b of the places of `where`."""
        return Looks(surface.bent_at(rows, b, mi.Bool(True)), rows.mirrored, where.triangles)

    @cached_property
    def sines(self) -> list[mi.Float]:
        """Of the angle by which normals are bent."""
        return [dr.norm(dr.cross(look.n, look.n_s)) for look in self.at]

    @property
    def step(self) -> mi.Float:
        """By about how much of itself the radiance steps."""
        return sum(self.sines) * (STEP_PER_SINE / len(self.at))

    def seen(self, eye: mi.Vector4f, slack: mi.Float) -> Seen:
        """From a viewpoint that is known up to `slack` [m]."""
        cos, h, reach = [], [], []
        for look in self.at:
            view = towards_viewer(eye, look.x)
            far = dr.norm(view)
            cos.append(dr.dot(look.n_s, view) / far)
            h.append(dr.dot(look.seen_from(cos[-1], self.mirrored), view) / far)
            reach.append(slack / far)
        return Seen(cos, h, most(reach), self.triangles)


@dataclass(frozen=True)
class Seen:
    """Parts of patches as they are seen at these places."""

    cos: list[mi.Float]  # between n_s and the direction to the viewer
    h: list[mi.Float]  # between the bent normal and this direction
    blur: mi.Float  # of both, as the viewpoint is not known
    triangles: tuple[tuple[int, int, int], ...]

    def crossed(self) -> mi.Float:
        """About how much of a part is crossed by curves."""
        near = least([dr.abs(value) for value in self.h]) < most(self.h) - least(self.h)
        share = mi.Float(0)
        for corners in self.triangles:
            own = [self.h[k] for k in corners]
            share += dr.select((least(own) <= self.blur) & (most(own) >= -self.blur), 1 / len(self.triangles), 0)
        return dr.maximum(share, dr.select(near, mi.Float(POSSIBLE), UNLIKELY))


def least(values: list[mi.Float]) -> mi.Float:
    return reduce(dr.minimum, values)


def most(values: list[mi.Float]) -> mi.Float:
    return reduce(dr.maximum, values)
