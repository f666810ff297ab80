"""Where bodies end that have neither triangles nor a pose of their own: curves, SDF grids, ellipsoids.

Lines across the film are halved until a hit grazes the surface: it is then next to the contour, the normal n there
nearly at right angles to the line of sight d. On the way to the contour n turns within the surface, along e,

    n_c ∝ n − (n·d) / (e·d) e,        n_c·d = 0,

round the axis of a tube (whose rulings have one normal), in a grid as the second derivatives of its values say, and
elsewhere towards d. What is left is of second order in n·d, a few thousandths; of linear curves, which Mitsuba meets to
about a thousandth of their radius, some hundredths of a tilt. Of B-splines, whose hits know their place on the curve
badly, the contour is sought where it passes closest by. Their tubes are open, and end at a rim round the axis. A grid
may end on the face of a cell as well (`chain_grids`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.tube_axis import Axis
from ..edges.copy_table import number_of
from ..scene.surfaces import Splines
from .chain_world import ChainWorld

#: Largest |n·d| at a hit next to a contour.
GRAZING = 0.35

#: Angle by which a tube is looked at inside of its contour [rad]. Rays meet it to about a thousandth of its radius, and
#: next to the contour with normals that are anything.
TURN = 1e-3

#: Steps of the search for where a contour passes closest by a line, the longest of them, and the difference in v that
#: slopes are taken over.
NEWTON_STEPS, LONGEST_STEP, DIFFERENCE = 6, 0.25, 1e-3

#: How far from its end, in segments, a tube is met next to its rim.
NEAR_END = 2e-3


@dataclass
class Outline:
    """The curve on which a surface ends, near a line of sight. Detached."""

    m: Hit  # the material point on it: a hit at distance 0
    n: mi.Vector3f  # unit, across curve and line of sight
    gap: mi.Float  # distance of the line of sight, signed by n [m]; infinite: there is no curve
    inside: mi.Vector3f  # from m to where the surface is looked at in place of what rays meet of it [m]; 0: is not

    def or_closer(self, other: Outline) -> Outline:
        """The one that the line of sight passes closer by."""
        return dr.select(dr.abs(other.gap) < dr.abs(self.gap), other, self)


def resting(hit: Hit, m: mi.Point3f, prim_uv: mi.Point2f) -> Hit:
    """The point `m` of the surface that `hit` meets, as a hit at distance 0."""
    nothing = dr.zeros(mi.Float, dr.width(hit.t))
    return Hit(mi.Point3f(m), mi.Vector3f(hit.d), nothing, hit.shape, hit.prim_index, mi.Point2f(prim_uv))


def contour(world: ChainWorld, hit: Hit, si: mi.SurfaceInteraction3f, line: mi.Ray3f, bends: mi.Bool) -> Outline:
    """The contour or rim next to the end `si` of `hit`: no farther off than lines are halved. None where it `bends`."""
    there = (hit.shape != 0) & ~si.shape.is_mesh() & ~bends
    m, p, n = resting(hit, si.p, hit.prim_uv), mi.Point3f(si.p), mi.Vector3f(si.n)
    round_, ends, r = line.d - dr.dot(n, line.d) * n, mi.Bool(False), mi.Float(0)
    if world.tables is not None and world.tables.rods is not None:
        segment, met = world.tables.rods.segment(hit.intersection(), there)
        rod = world.tables.rods.rod(segment, met)
        round_ = dr.select(met, dr.cross(rod.axis[0], n), round_)
        r = dr.select(met, rod.radius(dr.clip(rod.foot(si.p), 0, 1)), r)
    if world.tables is not None and world.tables.splines is not None:
        met, ends, axis, ρ, v = _on_spline(world.tables.splines, hit, si.p, line, there)
        p = dr.select(met & ~ends, axis.c + ρ, p)
        m = resting(hit, p, dr.select(met, mi.Point2f(v, 0), hit.prim_uv))
        n = dr.select(met, dr.normalize(axis.normal(ρ)), n)
        round_ = dr.select(met, dr.cross(axis.dc, n), round_)
        r = dr.select(met, axis.r, r)
    looked_at = mi.Vector3f(0)
    if world.surfaces.grids is not None:
        number = number_of(world.surfaces.copies, si)
        e, on_grid = world.surfaces.grids.turn(number, si.p, n, line.d)
        round_ = dr.select(on_grid & (dr.dot(e, line.d) != 0), e, round_)
        a, at_face = world.surfaces.grids.face(number, si.p)
        at_face &= there
        round_, ends = dr.select(at_face, dr.cross(n, a), round_), ends | at_face
        looked_at = world.surfaces.grids.inside(number, si.p, line.d)
    across = dr.dot(n, line.d)
    near = there & (ends | (dr.abs(across) < GRAZING))
    n = dr.select(ends, dr.cross(round_, line.d), n - round_ * (across / dr.dot(round_, line.d)))
    inside = dr.select(ends | (r == 0), 0, dr.normalize(round_) * dr.mulsign(TURN * r, -dr.dot(round_, line.d)))
    return Outline(m, dr.normalize(n), dr.select(near, mi.Float(0), dr.inf), inside + looked_at)


def _foot(line: mi.Ray3f, x: mi.Vector3f) -> mi.Vector3f:
    """The point of a line that is closest to x."""
    return mi.Vector3f(line.o + dr.dot(x - line.o, line.d) * line.d)


def _on_spline(splines: Splines, hit: Hit, x: mi.Point3f, line: mi.Ray3f, active: mi.Bool):
    """`(is x on a B-spline, next to a rim, axis, ρ, v)`: where the contour passes closest by the line; of rims, as met.

    Hits that graze a tube know their v badly. ρ leads from the axis to the point.
    """
    segment, met = splines.segment(hit.intersection(), active)
    first, last = splines.ends(segment, met)
    v = mi.Float(hit.prim_uv.x)
    rim = met & ((first & (v < NEAR_END)) | (last & (v > 1 - NEAR_END)))
    best, least = mi.Float(v), dr.full(mi.Float, dr.inf, dr.width(v))
    for _ in range(NEWTON_STEPS):
        off, ahead = (_off(line, *_seen_edge_on(splines, segment, w, line, met)) for w in (v, v + DIFFERENCE))
        nearer = dr.squared_norm(off) < least
        best, least = dr.select(nearer, v, best), dr.select(nearer, dr.squared_norm(off), least)
        slope = (ahead - off) / DIFFERENCE
        step = dr.dot(off, slope) / dr.maximum(dr.squared_norm(slope), dr.smallest(mi.Float))
        v = dr.clip(v - dr.clip(step, -LONGEST_STEP, LONGEST_STEP), 0, 1)
    v = dr.select(rim, hit.prim_uv.x, best)
    axis, ρ = _seen_edge_on(splines, segment, v, line, met)
    return met, rim, axis, dr.select(rim, axis.r * axis.circle(mi.Vector3f(x) - axis.c)[0], ρ), v


def _off(line: mi.Ray3f, axis: Axis, ρ: mi.Vector3f) -> mi.Vector3f:
    """From the line to a point of the surface."""
    return axis.c + ρ - _foot(line, axis.c + ρ)


def _seen_edge_on(splines: Splines, segment: mi.UInt32, v: mi.Float, line: mi.Ray3f, active: mi.Bool):
    """`(axis, ρ)`: of the two points of the circle at v that are seen edge-on, the one that the line is closer to."""
    axis, view = splines.axis(segment, v, active), mi.Vector4f(-line.d.x, -line.d.y, -line.d.z, 0)
    one, other = (axis.tangent_point(view, mi.Float(side))[0] for side in (1, -1))
    closer = dr.squared_norm(_off(line, axis, one)) < dr.squared_norm(_off(line, axis, other))
    return axis, dr.select(closer, one, other)
