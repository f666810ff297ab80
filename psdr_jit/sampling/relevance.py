"""Which edges the secondary boundary terms sample, how densely, and from where a resting edge can matter at all.

No viewpoint is known in the middle of a path, so the prior is length × exterior angle. On top of it only what forward
and backward mode both know: which shapes can move, where they are, and where the lights are.

Edges of shapes that rest count where something else slides: a receiver on a moving shape, here or further along the
sensor subpath. They share `STATIC_SHARE` of the samples, in proportion to how much of an edge's view is taken by
what moves; if the camera moves, or a light in the direct term, every edge moves relative to something.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..edges.curves import attached_to_world, curve_lengths
from ..edges.rows import EdgeRows
from ..edges.table import EdgeTable, scene_edges
from ..plan.job import Job
from .directions import Cone, Wedges, pdf_direction, pdf_view, sample_direction, sample_view, towards_sphere
from .distribution import EdgeDistribution, distribution_of

#: Share of the samples on edges of resting shapes while only shapes move.
STATIC_SHARE = 0.25

#: Relevance of a resting edge that no moving shape sees directly, only by way of other surfaces.
INDIRECT_RELEVANCE = 0.05

#: Emitters that are looked at one by one when asking whether an edge can cast a shadow.
MAX_EMITTERS = 16

#: Relative distance from a flat light's plane within which a point counts as unlit.
IN_PLANE = 1e-6


@dataclass(frozen=True)
class Movers:
    """Ball around everything that can move, if only shapes do. Opaque, so that motion compiles no new kernels."""

    centre: mi.Point3f
    radius: mi.Float

    def seen_from(self, x: mi.Point3f) -> Cone:
        return towards_sphere(x, self.centre, self.radius)


@dataclass(frozen=True)
class SecondaryEdges:
    """Edges of the scene, the density with which they are sampled, and what a resting edge has to look at."""

    table: EdgeTable
    distribution: EdgeDistribution
    movers: Movers | None
    resting: mi.Bool  # by row of the table: matters only through what slides; unused without movers
    ahead: float = 0.0  # share of a resting edge's directions that look past it at the movers, not from them

    def sample_view(self, e: EdgeRows, w: Wedges, row, x: mi.Point3f, u: mi.Point2f, active) -> mi.Vector3f:
        """Direction ω through the point `x` of edges `e` = `row`, from the viewer's side."""
        if self.movers is None:
            return sample_direction(e, w, u)[0]
        return sample_view(e, w, self.movers.seen_from(x), self._rests(row, active), self.ahead, u)[0]

    def pdf_view(self, e: EdgeRows, w: Wedges, row, x: mi.Point3f, ω: mi.Vector3f, active) -> mi.Float:
        """Density per solid angle of `sample_view`."""
        if self.movers is None:
            return pdf_direction(e, w, ω)
        return pdf_view(e, w, self.movers.seen_from(x), self._rests(row, active), self.ahead, ω)

    def _rests(self, row: mi.UInt32, active: mi.Bool) -> mi.Bool:
        return dr.gather(mi.Bool, self.resting, row, active)


def secondary_edges(job: Job, per_length, lights_count: bool, ahead: float = 0.0) -> SecondaryEdges | None:
    """All edges of the scene with weights for boundary segments anywhere; None if nothing can contribute.

    `per_length(rows)`: weight of straight edges per length; curves weigh π. `lights_count`: a light that moves makes
    every edge matter (its shadows move). `ahead`: see `SecondaryEdges`.
    """
    table = scene_edges(job)
    weights, resting, places = [], table.rests, []
    movers = _movers(job, lights_count)
    if table.has_segments:
        rows = table.segments.rows
        weights.append(dr.norm(rows.p1 - rows.p0) * per_length(rows))
        places.append((rows.p0 + rows.p1) / 2)
    if table.has_curves:
        rows = table.curves.rows
        weights.append(curve_lengths(table.curves) * dr.pi)
        to_world = attached_to_world(table.curves.shapes, rows.shape)
        places.append(mi.Point3f(dr.detach(to_world[3])))
    if movers is not None:
        weights = _balanced(weights, resting, [movers.seen_from(x).share for x in places])
    distribution = distribution_of(weights)
    if distribution is None:
        return None
    flags = mi.Bool(True)
    if movers is not None:
        joined = [dr.select(r, mi.UInt32(1), 0) for r in resting]
        flags = (joined[0] if len(joined) == 1 else dr.concat(joined)) != 0
    return SecondaryEdges(table, distribution, movers, flags, ahead)


def _movers(job: Job, lights_count: bool) -> Movers | None:
    """None if every edge moves relative to something, or if no shape moves."""
    facts = job.facts
    light_moves = facts.emitters_move or any(s.moves and s.is_emitter for s in facts.shapes)
    moving = [s for s in facts.shapes if s.index >= 0 and s.moves]
    if facts.camera_moves or (lights_count and light_moves) or not moving or not job.plan.prunes:
        return None
    shapes = job.scene.shapes()
    box = mi.ScalarBoundingBox3f()
    for s in moving:
        box.expand(shapes[s.index].bbox())
    sphere = box.bounding_sphere()
    return Movers(dr.opaque(mi.Point3f, list(sphere.center)), dr.opaque(mi.Float, float(sphere.radius)))


def _balanced(weights: list, resting: list, seen: list) -> list:
    """Resting edges weighed by what they see of the movers (share of all directions), and scaled to their share."""
    weights = [w * dr.select(r, s + INDIRECT_RELEVANCE, 1) for w, r, s in zip(weights, resting, seen, strict=True)]
    static = sum(dr.sum(dr.select(r, w, 0)) for w, r in zip(weights, resting, strict=True))
    moving = sum(dr.sum(dr.select(r, 0, w)) for w, r in zip(weights, resting, strict=True))
    both = (static > 0) & (moving > 0)
    scale = dr.select(both, STATIC_SHARE / (1 - STATIC_SHARE) * moving / static, 1)
    dr.make_opaque(scale)
    return [w * dr.select(r, scale, 1) for w, r in zip(weights, resting, strict=True)]


def can_cast_shadow(job: Job, rows: EdgeRows) -> mi.Bool:
    """May some emitter see the edge as a silhouette? False only if certainly none does.

    An edge lies in the planes of its faces, so which face turns to a point depends on the point alone; seen from all
    corners of a light's bounding box alike, it is alike from all of the light.
    """
    emitters = job.scene.emitters()
    if len(emitters) > MAX_EMITTERS or not job.plan.prunes:
        return mi.Bool(True)
    found = mi.Bool(False)
    for emitter, facts in zip(emitters, job.facts.emitters, strict=True):
        if facts.infinite and not facts.delta:
            return mi.Bool(True)
        if facts.infinite:
            axis = emitter.world_transform() @ mi.Vector3f(0, 0, -1)
            corners = [mi.Vector4f(dr.detach(axis.x), dr.detach(axis.y), dr.detach(axis.z), 0)]
            extremes = corners
        else:
            box = job.scene.shapes()[job.facts.shapes[facts.shape].index].bbox() if facts.shape >= 0 else emitter.bbox()
            corners = [dr.opaque(mi.Vector4f, [*box.corner(i), 1.0]) for i in range(8)]
            extremes = [corners[0], corners[7]]  # of all corners, the lowest and the highest in every coordinate
        possible = rows.border | rows.traced | _may_be_silhouette(rows, corners)
        if facts.shape >= 0 and job.facts.shapes[facts.shape].plugin in ("rectangle", "disk"):
            possible &= _in_front(rows, job.scene.shapes()[job.facts.shapes[facts.shape].index])
        found |= possible & ~_leaves_scene(rows, extremes, job.scene.bbox())
    return found


def _may_be_silhouette(rows: EdgeRows, corners: list[mi.Vector4f]) -> mi.Bool:
    """False where both faces turn to every corner, or both away from every corner."""
    both, neither = mi.Bool(True), mi.Bool(True)
    for c in corners:
        towards = mi.Vector3f(c.x, c.y, c.z) - c.w * mi.Vector3f(rows.p0)
        front0, front1 = dr.dot(rows.n0, towards) > 0, dr.dot(rows.n1, towards) > 0
        both &= front0 & front1
        neither &= ~front0 & ~front1
    return ~(both | neither)


def _leaves_scene(rows: EdgeRows, corners: list[mi.Vector4f], box: mi.ScalarBoundingBox3f) -> mi.Bool:
    """Does the shadow of the edge miss everything, because it starts on the scene's bounding box and leads out?"""
    leaves = mi.Bool(False)
    lower, upper = (dr.opaque(mi.Point3f, list(corner)) for corner in (box.min, box.max))  # the scene may grow
    for axis in range(3):
        for sign, face in ((-1, lower[axis]), (1, upper[axis])):
            margin = IN_PLANE * (dr.abs(face) + upper[axis] - lower[axis])
            outward = (dr.abs(rows.p0[axis] - face) <= margin) & (dr.abs(rows.p1[axis] - face) <= margin)
            for c in corners:
                outward &= sign * (c[axis] - c.w * face) < -margin  # the light is on the inner side
            leaves |= outward
    return leaves


def _in_front(rows: EdgeRows, light: mi.Shape) -> mi.Bool:
    """Does any point of an edge lie on the side to which a flat light shines?"""
    with dr.suspend_grad():
        ps = light.sample_position(0, mi.Point2f(0.5))
        n, p = mi.Vector3f(dr.detach(ps.n)), mi.Point3f(dr.detach(ps.p))
        dr.make_opaque(n, p)
    height = dr.maximum(dr.dot(n, rows.p0 - p), dr.dot(n, rows.p1 - p))
    return height > IN_PLANE * (dr.norm(p) + dr.norm(rows.p1 - rows.p0))
