"""Directions of lines through edges of shapes that rest: towards, and away from, what moves.

An edge of a shape that rests matters where its viewer is on something that moves, or where that is what is seen past
it, directly or in a mirror (`mirror_images.py`): half of its directions are uniform in the cones in which the ball
around all movers is seen, the others are those in which any edge of its kind matters (one-sample balance heuristic
[Veach 1997, §9.2.4]).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.cones import Cone, Cones
from ..edges.wedges import Wedges

#: Share of the directions of a resting edge that lead to the movers.
CONE_SHARE = 0.5


def sample_view(
    w: Wedges, cone: Cone | Cones, rests: mi.Bool, ahead: float, u: mi.Point2f
) -> tuple[mi.Vector3f, mi.Float]:
    """As `Wedges.sample`, with the mixture for edges that rest: `(ω, pdf_sa)`.

    `ahead`: share of the cone's directions in which what moves is seen past the edge; otherwise the viewer is on it.
    """
    into_cone = rests & (u.x < CONE_SHARE)
    rescaled = dr.select(into_cone, u.x / CONE_SHARE, (u.x - CONE_SHARE) / (1 - CONE_SHARE))
    u = mi.Point2f(dr.select(rests, rescaled, u.x), u.y)
    ω, _ = w.sample(u)
    forwards = u.x < ahead
    rescaled = dr.select(forwards, u.x / max(ahead, dr.smallest(mi.Float)), (u.x - ahead) / (1 - ahead))
    towards = cone.sample(mi.Point2f(rescaled, u.y))
    ω = dr.select(into_cone, dr.select(forwards, towards, -towards), ω)
    return ω, pdf_view(w, cone, rests, ahead, ω)


def pdf_view(w: Wedges, cone: Cone | Cones, rests: mi.Bool, ahead: float, ω: mi.Vector3f) -> mi.Float:
    """Density per solid angle of `sample_view`."""
    pdf = w.pdf(ω)
    in_cone = ahead * cone.pdf(ω) + (1 - ahead) * cone.pdf(-ω)
    return dr.select(rests, CONE_SHARE * in_cone + (1 - CONE_SHARE) * pdf, pdf)
