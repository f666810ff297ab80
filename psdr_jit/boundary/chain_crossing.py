"""Where a searched line crosses a curve: what it crosses, how fast F changes along the film there, and the way back.

The same for lines across the film (`chain`) and across what lights shine on (`light_chain`): with F the signed distance
of the last line of sight from the curve, and its slope (F_x, F_y) by the place p on the film, the crossing of a line
along the axis X stands for −F_X / |∇F|² per unit of F_θ.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core.ad import backpropagate, tangents
from ..core.records import Hit
from ..paths.rays import ROUNDING
from ..paths.surface_at import surface_of
from .chain_outline import Curve, crossed_curve
from .chain_patterns import NO_FAMILY
from .chain_sweeps import AtRest, slope_at_end
from .chain_trace import ChainRecords, Pair
from .chain_world import ChainWorld
from .searched_lines import SearchedLines

#: Largest distance on the film from a crossing to the curve that it is thought to belong to [px, or cells]: halving
#: ends closer.
MOST_OFF = 0.02


def crossings(lines: SearchedLines, found) -> tuple[ChainRecords, Pair, Curve]:
    """Of the intervals that `chain_search` has `found`: the chains at their ends, and the curves in between."""
    chain = ChainRecords(dr.width(found.k), lines.world.depth)
    pair = lines.compare(found.at.sample, (found.at.lo, found.at.hi), chain)
    dr.eval(pair, chain.hits, chain.bends)
    sight = dr.select(pair.horizon, chain.segment(pair.sight, pair.horizon), pair.a)
    curve = crossed_curve(lines.world, lines.analytic, pair, sight)
    curve.valid &= ~starts_behind(lines.world, pair)
    dr.eval(curve)
    return chain, pair, curve


def starts_behind(world: ChainWorld, pair: Pair) -> mi.Bool:
    """Do the paths part because one of them begins its segment behind the face of a mesh that the other meets?

    Rays start a small height off their surfaces. Inside of a body with a sharp edge, as near to it as that height, they
    start outside and never come back in: there is no such gap. Which side it is on is known up to rounding.
    """
    a, b = pair.a, pair.b
    first = (a.shape != 0) & ((b.shape == 0) | (a.t < b.t))
    met, other = dr.select(first, a, b), dr.select(first, b, a)
    asked = (met.shape != 0) & (pair.last > 0) & ~pair.horizon & (pair.family == NO_FAMILY)
    si = surface_of(world.tables, met, asked, mi.RayFlags.Minimal)
    rounding = ROUNDING * (1 + dr.max(dr.abs(si.p)))
    behind = dr.mulsign(dr.dot(si.n, si.p - other.o), dr.dot(si.n, met.d)) <= rounding
    return asked & si.shape.is_mesh() & behind


def sampled_as_edge(world: ChainWorld, pair: Pair, sight: Hit) -> mi.Bool:
    """Is the crossing left to `primary`? Horizons that the camera sees are if a mirror reflects along its face there
    (`edges.kind_mirror_horizon`), or if they lie on an edge. `sight`: the segment that meets the crossed curve.
    """
    seen = pair.horizon & (pair.sight == 0)
    si = surface_of(world.tables, sight, seen)
    reflected = dr.dot(si.sh_frame.n, pair.a.d) * dr.dot(si.sh_frame.n, sight.d) < 0
    return seen & (reflected | ~pair.one_face)


def step_per_slope(lines: SearchedLines, chain: ChainRecords, end, at: tuple, first: Callable):
    """`(valid, −F_X / |∇F|²)` at `at`: (place, line); `first` gives the attached starts and directions of the first
    segments at a place. Detached."""
    p, line = at
    F_x, F_y = (_slope(lines, chain, end, p, axis, first) for axis in (0, 1))
    slope2 = dr.square(F_x) + dr.square(F_y)
    valid = end.curve.valid & (dr.square(end.curve.F) < dr.square(MOST_OFF) * slope2)
    along = dr.select(line.horizontal, F_x, F_y)
    return valid, -along / slope2


def _slope(lines: SearchedLines, chain: ChainRecords, end, p: mi.Point2f, axis: int, first: Callable) -> mi.Float:
    """Derivative of F by the place on the film, along one axis."""
    q = mi.Point2f(p)
    with dr.resume_grad():
        dr.enable_grad(q)
    with dr.resume_grad(q):
        dr.set_grad(q, mi.Point2f(1 - axis, axis))
        o_grad, d_grad = tangents(*first(q))
    still = AtRest(lines.job.sensor, lines.job.surfaces)
    return slope_at_end(lines.job.facts, chain, end, (o_grad, d_grad), still)


def adjoint_of_speed(splat: Callable[[mi.Float], mi.TensorXf], count: int, grad_in: mi.TensorXf) -> mi.Float:
    """Derivative of ⟨grad_in, splat(F_θ)⟩ by F_θ of each of `count` crossings."""
    with dr.resume_grad():
        F_grad = dr.zeros(mi.Float, count)
        dr.enable_grad(F_grad)
    with dr.resume_grad(F_grad):
        backpropagate(splat(F_grad), grad_in)
        return dr.grad(F_grad)
