"""Straight edges and analytic curves of a set of shapes as one table with one distribution."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..analytic_edges import CurveSet, curve_set
from ..edge_distribution import EdgeDistribution, edge_distribution
from ..edge_set import EdgeSet, edge_set
from ..job import Job
from ..scene_analysis import ShapeFacts
from .edge_points import EdgePoint, curve_motion, curve_sides, segment_motion, segment_sides


@dataclass(frozen=True)
class EdgeTable:
    """Rows of `segments` first, then those of `curves`; either may be absent."""

    segments: EdgeSet
    curves: CurveSet

    @property
    def segment_count(self) -> int:
        return 0 if self.segments.rows is None else dr.width(self.segments.rows.v0)

    @property
    def has_segments(self) -> bool:
        return self.segments.rows is not None

    @property
    def has_curves(self) -> bool:
        return self.curves.rows is not None


def edge_table(job: Job, chosen: list[ShapeFacts]) -> EdgeTable:
    """Edges of the `chosen` shapes; mesh topologies live in the job's cache."""
    shapes = job.scene.shapes()
    meshes = [s for s in chosen if s.is_mesh]
    segments = edge_set([shapes[s.index] for s in meshes], [s.moves for s in meshes], job.cache)
    curves = curve_set([(shapes[s.index], s.plugin) for s in chosen if not s.is_mesh])
    return EdgeTable(segments, curves)


def distribution_of(weights: list[mi.Float]) -> EdgeDistribution | None:
    """Distribution over the concatenated weights of straight rows and curve rows; None if all vanish."""
    if not weights:
        return None
    distribution = edge_distribution(weights[0] if len(weights) == 1 else dr.concat(weights))
    return distribution if float(distribution.total[0]) > 0 else None


def sides(scene: mi.Scene, table: EdgeTable, row, t, point: EdgePoint, scale, which, wavelengths):
    """What lies on side `which` (0: −, 1: +) of edge points: `(ray, pi, differs)`; own faces known, the rest traced.

    `scale`: size of the shape, on curves. `differs` is False where both sides are certainly alike.
    """
    straight = row < table.segment_count
    side, differs = None, mi.Bool(True)
    if table.has_segments:
        side, differs = segment_sides(table.segments, row, t, point, which, straight)
    if table.has_curves:
        on_curve = curve_sides(point, scale, which)
        side = on_curve if side is None else dr.select(straight, side, on_curve)
        differs |= ~straight
    ray = side.ray
    ray.wavelengths = wavelengths
    found = scene.ray_intersect_preliminary(ray, coherent=False, active=side.traced & differs)
    return ray, dr.select(side.traced, found, side.pi), differs


def compact(record, active: mi.Bool):
    """The lanes of `record` (a dataclass of arrays) that are active. Evaluates.

    All fields are evaluated in one kernel first: a gather from pending arrays would launch one for each.
    """
    dr.eval(record, active)
    return dr.gather(type(record), record, dr.compress(active))


def edge_motion(table: EdgeTable, row: mi.UInt32, t: mi.Float, local: mi.Point3f) -> mi.Vector3f:
    """Vector of value 0 whose derivative is the material velocity of the edge point, attached.

    `local`: material point of a curve (object space), unused on straight edges.
    """
    straight = row < table.segment_count
    motion = mi.Vector3f(0)
    if table.has_segments:
        x = segment_motion(table.segments, row, t, straight)
        motion += dr.select(straight, x - dr.detach(x), 0)
    if table.has_curves:
        x = curve_motion(table.curves, row - table.segment_count, local, ~straight)
        motion += dr.select(straight, 0, x - dr.detach(x))
    return motion
