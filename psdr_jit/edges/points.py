"""Steps off an edge: how far beside it and in front of it rays are traced, so that they see what they should."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.lift import start_height
from ..paths.rays import ROUNDING

#: Sideways distance at which a ray that passes an edge is traced, relative to the distance from the scene's centre: far
#: below anything one can see.
SIDE_OFFSET = 3e-6

#: The side rays start this many side offsets in front of the edge: an edge that rests on another surface is then
#: seen against that surface, and the ray does not start beneath it.
LEAD = 100.0

#: The same for what rounding adds: far from the origin, a hundredfold is no small distance.
ROUNDING_LEAD = 10.0

#: Share of the way from the edge to its face's centroid at which the face's own radiance is taken. On the edge itself
#: rounding may put the point inside a surface on which the edge rests, and everything it sees would be occluded.
INSET = 3e-4

#: Largest such share, in sharp corners: see `face_inset`.
LARGEST_INSET = 0.3

#: We stay clear of the height at which Mitsuba starts rays by this factor; of surfaces that meet almost flush, as if
#: by this sine of their angle.
CLEAR_OF_LIFT, LEAST_SLANT = 2.0, 0.05

#: Largest step aside that is taken to stay clear of it: this share of the viewer's distance.
LARGEST_STEP = 1e-3

#: Sine of the angle to its plane below which a face is seen edge-on: sixteen units in the last place of a direction.
EDGE_ON = 1e-6

#: Cosine below which a visibility ray along a face is so near to it, until it ends, that it may meet it by rounding: at
#: 1.3e-4 a third do (a quad of a ball of 32 000 faces, 5 % of a pixel), at 2e-3 none.
NEARLY_EDGE_ON = 1e-3

#: Cosine above which a face hides no more of a ray aimed at it, beside its edge, than such a ray leaves out.
CLEARLY_SEEN = 2e-2

#: Share of the distance to the edge that a visibility ray leaves out.
VISIBILITY_EPSILON = 1e-4


def clearance(x: mi.Point3f, size: mi.Float, centre: mi.Point3f, blur: mi.Float | float = 0.0):
    """Steps off an edge at `x` [m]: `(sideways, along the line, clear of what the edge rests on)`.

    `size`: of the edge or its shape; `centre`: of the scene, so that its place in space matters by rounding only;
    `blur`: of the faces at the edge.
    """
    visible = SIDE_OFFSET * (dr.max(dr.abs(x - centre)) + size)
    rounding = ROUNDING * dr.max(dr.abs(x)) + blur
    return visible + rounding, LEAD * visible + ROUNDING_LEAD * rounding


def clear_of_lift(x: mi.Point3f) -> mi.Float:
    """A height above a surface at `x` that is clear of the one at which Mitsuba starts rays [m]."""
    return CLEAR_OF_LIFT * start_height(x)


def cot_between(n0: mi.Normal3f, n1: mi.Normal3f) -> mi.Float:
    """|cot φ| of the angle φ at which surfaces with these unit normals meet, bounded where they are nearly flush."""
    return dr.abs(dr.dot(n0, n1)) / dr.maximum(dr.norm(dr.cross(n0, n1)), LEAST_SLANT)


def past_lift(x: mi.Point3f, offset: mi.Float, lead: mi.Float, r: mi.Float) -> tuple[mi.Float, mi.Float]:
    """`offset` and `lead`, or more, with which what an outline at `x` hides is looked at from the distance r [m].

    Where the shape cuts into another, what it hides begins beside its outline. Rays that Mitsuba starts nearer to the
    outline than its height start inside of the shape, in the dark. What the shape stands on is looked at from above
    by rays that start as much farther in front as they pass farther aside.
    """
    farther = dr.maximum(0, dr.minimum(clear_of_lift(x), LARGEST_STEP * r) - offset)
    return offset + farther, lead + LEAD * farther


def face_inset(p0: mi.Point3f, p1: mi.Point3f, apex: mi.Point3f, n0: mi.Normal3f, n1: mi.Normal3f) -> mi.Float:
    """Share of the way to the centroid at which a face with this `apex` is looked at from its edge p0 p1.

    Mitsuba starts rays a height h above a face. Where two faces meet at an angle φ < 90 degrees (cos φ = -n0·n1), what
    is nearer to the edge than h cot φ is then behind the other face, in the dark.
    """
    cot = dr.maximum(-dr.dot(n0, n1), 0) / dr.maximum(dr.norm(dr.cross(n0, n1)), LEAST_SLANT)
    depth = dr.norm(dr.cross(p1 - p0, apex - p0)) / (3 * dr.norm(p1 - p0))
    needed = dr.maximum(clear_of_lift(p0), clear_of_lift(p1)) * cot
    return dr.select(needed < LARGEST_INSET * depth, dr.maximum(needed / depth, INSET), LARGEST_INSET)


def facing(n: mi.Normal3f, towards: mi.Vector3f) -> mi.Float:
    """n·towards: > 0 where a face with unit normal `n` turns to a viewer in that direction (of any length), < 0 where
    its back does, and 0 where it is seen edge-on.

    The one rule for faces in line with the viewer, whose sign is a matter of rounding and may differ from one edge of
    a face to the next: such a face is not seen, and turns away.
    """
    cos = dr.dot(n, towards)
    return dr.select(dr.abs(cos) > EDGE_ON * dr.norm(towards), cos, 0)


def face_sides(n0: mi.Normal3f, n1: mi.Normal3f, ω: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """On which side of an edge seen along ω its faces lie: the signs of b_i·(τ×ω), b_i the direction into face i.

    As b_0 = n_0 × τ and b_1 = τ × n_1, a face lies to the one side or to the other as its front or back is seen.
    """
    return facing(n0, -ω), -facing(n1, -ω)
