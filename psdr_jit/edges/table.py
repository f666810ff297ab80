"""All edges of a scene in one table: the rows of every kind, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from ..core.lift import INSIDE, seen_side, start_height
from .contact_limits import Touching
from .kind import EdgeKind, OnEdge, Side, Sight
from .location import EdgeLocation
from .points import clear_of_lift

T = TypeVar("T")

#: Share of the way from an edge to what is close behind it at which a line along it starts.
HALFWAY = 0.5

#: Distance behind an outline up to which what it hides is looked at once more, in heights at which rays start.
NEXT_TO_OUTLINE = 100.0


@dataclass(frozen=True)
class EdgeTable:
    """Rows of `kinds` in order. Lanes may hold rows of different kinds: `ask` puts a question to each about its own."""

    kinds: tuple[EdgeKind, ...]
    buried: int = 0  # edges that are left out because no path can reach them
    touching: Touching = Touching()

    @property
    def count(self) -> int:
        return sum(kind.count for kind in self.kinds)

    def ask(
        self,
        row: mi.UInt32,
        question: Callable[[EdgeKind, mi.UInt32, mi.Bool], T],
        among: Callable[[EdgeKind], bool] = lambda kind: True,
    ) -> T:
        """`question(kind, row of that kind, active)`, answered for every lane by the kind that its row belongs to.

        Kinds that are not `among` those asked must not occur in `row`.
        """
        answer, first = None, 0
        for kind in self.kinds:
            if among(kind):
                own = (row >= first) & (row < first + kind.count) if len(self.kinds) > 1 else mi.Bool(True)
                found = question(kind, row - first, own)
                answer = found if answer is None else dr.select(own, found, answer)
            first += kind.count
        return answer

    def within_surfaces(self, row: mi.UInt32) -> mi.Bool | None:
        """Which of these edges are steps inside of a surface that may lie close to its outline; None: no kind does."""
        if not any(kind.near_outlines for kind in self.kinds):
            return None
        return self.ask(row, lambda kind, _, own: own & kind.near_outlines)

    def weights(self, of: Callable[[EdgeKind], mi.Float]) -> list[mi.Float]:
        """By kind, the column `of` its rows."""
        return [of(kind) for kind in self.kinds]

    def moving(self) -> list[mi.Bool]:
        """By kind: which rows can move."""
        return [kind.moving() for kind in self.kinds]

    def moves(self, at: EdgeLocation) -> mi.Bool:
        """Can the edges at these locations move?"""
        return self.ask(at.row, lambda kind, row, own: dr.gather(mi.Bool, kind.moving(), row, own))

    def on(self, row: mi.UInt32, t: mi.Float, view: mi.Vector4f) -> OnEdge:
        """The point at t of `row` for a viewpoint (homogeneous)."""
        return self.ask(row, lambda kind, own_row, own: kind.on(own_row, t, view, own))

    def aim(self, sight: Sight) -> mi.Point3f:
        """Where rays are aimed that ask whether the viewer sees the edges."""
        return self.ask(sight.at.row, lambda kind, row, own: kind.aim(row, sight, own))

    def body(self, sight: Sight) -> mi.Point3f:
        """Points of the sheets that end at the edges."""
        return self.ask(sight.at.row, lambda kind, row, own: kind.body(row, sight, own))

    def lies_in(self, sight: Sight) -> mi.Normal3f:
        """Unit normals of the flat faces on which the edges lie; 0 where they lie on none."""
        return self.ask(sight.at.row, lambda kind, row, own: kind.lies_in(row, sight, own))

    def face_along(self, row: mi.UInt32, ω: mi.Vector3f) -> mi.Normal3f:
        """Unit normals of the faces at the edges that are most nearly in line with ω; 0 where there are none."""
        return self.ask(row, lambda kind, own_row, own: kind.face_along(own_row, ω, own))

    def displacement(self, at: EdgeLocation, ω: mi.Vector3f) -> mi.Vector3f:
        """Vector of value 0 whose derivative is the velocity of the edges there, seen along ω, attached."""
        return self.ask(at.row, lambda kind, row, own: kind.displacement(row, at, ω, own))

    def turn(self, at: EdgeLocation, ω: mi.Vector3f, n_perp: mi.Vector3f) -> mi.Vector3f:
        """By how much the edges there move along n_perp as ω turns: a covector on ω̇ [m]."""
        return self.ask(at.row, lambda kind, row, own: kind.turn(row, at, ω, n_perp, own))

    def side(self, sight: Sight, which: mi.UInt32) -> Side:
        """Where to look on side `which` (0: −n_perp, 1: +n_perp) of edges."""
        return self.ask(sight.at.row, lambda kind, row, own: kind.side(row, sight, which, own))


def look_beside(scene: mi.Scene, table: EdgeTable, sight: Sight, which: mi.UInt32, wavelengths, coherent: bool = False):
    """What lies on side `which` of edges: `(ray, pi, differs)`; own faces are known, the rest is traced.

    `differs` is False where both sides are certainly alike. `coherent`: rays of neighbouring lanes are nearly alike,
    and traced together.
    """
    side = table.side(sight, which)
    ray, pi = traced(scene, side, sight, side.differs, wavelengths, coherent)
    return ray, pi, side.differs


def look_behind(scene: mi.Scene, table: EdgeTable, sight: Sight, which: mi.UInt32, wavelengths):
    """What lies on side `which` of edges and moves against them: `(ray, pi, r)`, `r` its distance from x_B.

    The edge's own surface moves as the edge does and is left out (`pi` invalid), but for intersection curves and for
    borders of several shapes at one place.
    """
    side = table.side(sight, which)
    wanted = side.differs & ~side.own
    ray, pi = traced(scene, side, sight, wanted, wavelengths)
    pi.valid = pi.valid & wanted
    beyond = dr.dot(ray.o + pi.t * ray.d - sight.at.x, ray.d)
    return ray, pi, dr.select(side.traced, dr.maximum(beyond, 0), 0)


def traced(scene: mi.Scene, side: Side, sight: Sight, wanted: mi.Bool, wavelengths, coherent: bool = False):
    """What lies on a side: `(ray, pi)`, traced where `wanted`.

    Another shape next to an outline is looked at once more. From farther aside, where rays cannot start there as they
    start elsewhere: at their height they are behind what they should pass. Nothing else is, for that far aside the
    next fold of the shape, or the gap below it, may have ended as well. Elsewhere along the line itself, from behind
    the edge on: how bright a wall is next to a board that hangs before it changes within that distance, times the
    slant of the line.
    """
    ray, asked = side.ray, side.traced & wanted
    ray.wavelengths = wavelengths
    found = scene.ray_intersect_preliminary(ray, coherent=coherent, active=asked)
    beyond = dr.dot(ray.o + found.t * ray.d - sight.at.x, ray.d)
    again = asked & found.is_valid() & (beyond < NEXT_TO_OUTLINE * clear_of_lift(sight.at.x)) & dr.any(side.aside != 0)
    again &= dr.reinterpret_array(mi.UInt32, found.shape) != side.shape
    behind = rays_start_behind(scene, sight.at.x, ray, found, again)
    other = mi.Ray3f(ray)
    other.o = dr.select(behind, ray.o + side.aside, sight.at.x + HALFWAY * beyond * ray.d)
    met = scene.ray_intersect_preliminary(other, coherent=coherent, active=again)
    # Rays along a line that touches a curved shape do not start clear of it.
    again &= behind | (met.is_valid() & (met.shape == found.shape) & (sight.at.scale == 0))
    ray.o = dr.select(again, other.o, ray.o)
    return ray, dr.select(side.traced, dr.select(again, met, found), side.pi)


def rays_start_behind(
    scene: mi.Scene, x: mi.Point3f, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, asked: mi.Bool
) -> mi.Bool:
    """Is an edge at x lower above the surface that `ray` meets behind it than rays start there, or do these start
    behind something?
    """
    si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, asked)
    n = seen_side(si, ray.d)
    height = start_height(si.p)
    up = mi.Ray3f(si.p + INSIDE * height * n, n, (1 - INSIDE) * height, 0, ray.wavelengths)
    return (dr.dot(n, x - si.p) < height) | scene.ray_test(up, asked)
