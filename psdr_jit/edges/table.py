"""Straight edges and analytic curves of a set of shapes as one table with one distribution."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.compat import mesh_buffers
from ..core.memory import Slot
from ..core.sensor_frame import SensorFrame, origin_box, sensor_frame
from ..plan.job import Job
from ..scene.facts import ShapeFacts
from ..scene.tangent_facts import vertex_speeds
from .buried import buried
from .curves import CurveSet, curve_set
from .junctions import Ball
from .location import EdgeLocation
from .overlaps import apart, box_of, crossing, warn_about_pairs
from .points import EdgePoint, Side, curve_motion, curve_sides, segment_motion, segment_sides
from .rows import EdgeRows
from .segments import EdgeSet, edge_set

#: Of one render call: the table, and the geometry of its sensor.
TABLE: Slot[EdgeTable | None] = Slot(lambda: None)
FRAME: Slot[SensorFrame | None] = Slot(lambda: None)

#: Of an integrator: the arrays that straight edges were made from while every shape rests, and these edges.
RESTING: Slot[tuple[list, EdgeSet] | None] = Slot(lambda: None)


@dataclass(frozen=True)
class EdgeTable:
    """Rows of `segments` first, then those of `curves`; either may be absent."""

    segments: EdgeSet
    curves: CurveSet
    curve_moves: mi.UInt32  # by CurveRows.shape: 1 if the shape can move
    centre: mi.Point3f  # of the scene's bounding box
    buried: int = 0  # straight edges that are left out because no path can reach them

    @property
    def segment_count(self) -> int:
        return 0 if self.segments.rows is None else dr.width(self.segments.rows.v0)

    @property
    def rests(self) -> list[mi.Bool]:
        """Rows whose shapes cannot move: straight ones, curves; whatever there is of them."""
        found = [~self.segments.rows.moves] if self.has_segments else []
        if self.has_curves:
            found.append(dr.gather(mi.UInt32, self.curve_moves, self.curves.rows.shape) == 0)
        return found

    @property
    def has_segments(self) -> bool:
        return self.segments.rows is not None

    @property
    def has_curves(self) -> bool:
        return self.curves.rows is not None

    def moves(self, at: EdgeLocation) -> mi.Bool:
        """Can these edges move?"""
        straight = at.row < self.segment_count
        moves = mi.Bool(False)
        if self.has_segments:
            moves |= dr.gather(mi.Bool, self.segments.rows.moves, at.row, straight)
        if self.has_curves:
            shape = dr.gather(mi.UInt32, self.curves.rows.shape, at.row - self.segment_count, ~straight)
            moves |= dr.gather(mi.UInt32, self.curve_moves, shape, ~straight) != 0
        return moves

    def displacement(self, at: EdgeLocation) -> mi.Vector3f:
        """Vector of value 0 whose derivative is the material velocity of the edge point, attached."""
        straight = at.row < self.segment_count
        motion = mi.Vector3f(0)
        if self.has_segments:
            motion += dr.select(straight, segment_motion(self.segments, at.row, at.t, straight), 0)
        if self.has_curves:
            x = curve_motion(self.curves, at.row - self.segment_count, at.local, ~straight)
            motion += dr.select(straight, 0, x - dr.detach(x))
        return motion


def scene_edges(job: Job) -> EdgeTable:
    """Edges of all shapes, built once per render call; mesh topologies outlive it."""
    if job.shared[TABLE] is None:
        job.shared[TABLE] = _edge_table(job)
    return job.shared[TABLE]


def _seen_from_outside(job: Job, meshes: list[ShapeFacts]) -> mi.Float:
    """1 for every mesh of which light paths from the sensor meet the outer side only, if it is closed; else 0.

    Paths do not enter a closed opaque shape; they may start in it.
    """
    lower, upper = origin_box(shared_frame(job))
    flags = []
    for facts in meshes:
        flags.append(float(facts.opaque and apart(lower, upper, job.scene.shapes()[facts.index].bbox())))
    return mi.Float(flags)


def shared_frame(job: Job) -> SensorFrame:
    """Geometry of the job's sensor, read once per render call."""
    if job.shared[FRAME] is None:
        job.shared[FRAME] = sensor_frame(job.sensor)
    return job.shared[FRAME]


def _segments(job: Job, meshes: list[ShapeFacts], balls: tuple[Ball, ...]) -> EdgeSet:
    """Straight edges of the scene; kept from call to call while every shape rests."""
    shapes = [job.scene.shapes()[s.index] for s in meshes]
    if job.facts.shapes_move or balls or not job.plan.prunes:
        return edge_set(shapes, [s.moves for s in meshes], job.call.memory, balls)
    buffers = [buffer for shape in shapes for buffer in mesh_buffers(shape)]
    known = job.call.memory[RESTING]
    # a buffer that is kept keeps its index, and whatever writes to a mesh gives it another buffer
    same = known is not None and [b.index for b in known[0]] == [b.index for b in buffers]
    if not same:
        known = (buffers, edge_set(shapes, [False] * len(shapes), job.call.memory))
        job.call.memory[RESTING] = known
    rows = known[1].rows
    return known[1] if rows is None else replace(known[1], meshes=tuple(shapes), rows=copy(rows))


def _edge_table(job: Job) -> EdgeTable:
    shapes = job.scene.shapes()
    chosen = [s for s in job.facts.shapes if s.index >= 0]
    meshes, analytic = [s for s in chosen if s.is_mesh], [s for s in chosen if not s.is_mesh]
    balls = tuple(Ball(shapes[s.index], s.moves) for s in analytic if s.plugin == "sphere")
    pairs = crossing([box_of(shapes[s.index]) for s in chosen])
    warn_about_pairs([(shapes[s.index], s.plugin) for s in chosen], pairs, job.call.memory)
    overlapping = [chosen[k] for k in sorted({k for pair in pairs for k in pair})]
    segments, buried_count = _without_buried(job, _segments(job, meshes, balls), overlapping)
    if segments.rows is not None:
        outside = _seen_from_outside(job, meshes)
        rows = segments.rows  # not in place: the arrays may be those of the cached topology
        rows.shell0 = rows.shell0 * dr.gather(mi.Float, outside, rows.shape0)
        rows.shell1 = rows.shell1 * dr.gather(mi.Float, outside, rows.shape1)
        if job.options.direction == "known" and job.plan.prunes:
            speed = vertex_speeds(segments.meshes)
            moved = sum(dr.gather(mi.Float, speed, v) for v in (rows.v0, rows.v1)) > 0
            rows.moves = rows.moves & (moved | (rows.junction > 0))
        dr.eval(rows)  # now, and not with whichever term needs them first: that one's kernels would differ
    curves = curve_set([(shapes[s.index], s.plugin) for s in analytic])
    centre = dr.opaque(mi.Point3f, list(job.scene.bbox().center()))
    return EdgeTable(segments, curves, mi.UInt32([int(s.moves) for s in analytic]), centre, buried_count)


def _without_buried(job: Job, segments: EdgeSet, bodies: list[ShapeFacts]) -> tuple[EdgeSet, int]:
    """Straight edges that a path may reach, and how many others there are."""
    # while a function is being frozen, values cannot be read: nothing is left out
    if segments.rows is None or not job.plan.prunes or dr.flag(dr.JitFlag.FreezingScope):
        return segments, 0
    hidden = buried(job, segments.rows, bodies, shared_frame(job))
    count = 0 if hidden is None else int(dr.count(hidden)[0])
    if count == 0:
        return segments, 0
    total = dr.width(segments.rows.v0)
    return replace(segments, rows=compact(segments.rows, ~hidden) if count < total else None), count


def edge_samples(job: Job, frame: SensorFrame, paths: int) -> int:
    """Number of edge samples for a term's budget, which counts paths: one edge sample takes `paths` of them."""
    return max(1, job.spp * frame.crop_size[0] * frame.crop_size[1] // paths)


def sides(scene: mi.Scene, table: EdgeTable, row, t, point: EdgePoint, scale, which, wavelengths):
    """What lies on side `which` (0: −, 1: +) of edge points: `(ray, pi, differs)`; own faces known, the rest traced.

    `scale`: size of the shape, on curves. `differs` is False where both sides are certainly alike.
    """
    side, differs = _side(table, row, t, point, scale, which)
    ray = side.ray
    ray.wavelengths = wavelengths
    found = scene.ray_intersect_preliminary(ray, coherent=False, active=side.traced & differs)
    return ray, dr.select(side.traced, found, side.pi), differs


def background(scene: mi.Scene, table: EdgeTable, row, t, point: EdgePoint, scale, which, wavelengths):
    """What lies on side `which` of edge points and moves against them: `(ray, pi, r)`, `r` its distance from x_B.

    The edge's own surface moves as the edge does and is left out (`pi` invalid), but for intersection curves and for
    borders of several shapes at one place.
    """
    straight = row < table.segment_count
    side, differs = _side(table, row, t, point, scale, which)
    wanted = differs
    if table.has_curves:
        wanted &= straight | (which == 1)
    if table.has_segments:
        e = dr.gather(EdgeRows, table.segments.rows, row, straight)
        own = straight & ~side.traced & (e.junction == 0) & ((e.shape0 == e.shape1) | ~e.moves)
        wanted &= ~own
    ray = side.ray
    ray.wavelengths = wavelengths
    found = scene.ray_intersect_preliminary(ray, coherent=False, active=side.traced & wanted)
    pi = dr.select(side.traced, found, side.pi)
    pi.valid = pi.valid & wanted
    beyond = dr.dot(ray.o + pi.t * ray.d - point.x, ray.d)
    return ray, pi, dr.select(side.traced, dr.maximum(beyond, 0), 0)


def _side(table: EdgeTable, row, t, point: EdgePoint, scale, which) -> tuple[Side, mi.Bool]:
    """Where to look on side `which`, and whether the two sides can differ."""
    straight = row < table.segment_count
    side, differs = None, mi.Bool(True)
    if table.has_segments:
        side, differs = segment_sides(table.segments, table.centre, row, t, point, which, straight)
    if table.has_curves:
        on_curve = curve_sides(point, table.centre, scale, which)
        side = on_curve if side is None else dr.select(straight, side, on_curve)
        differs |= ~straight
    return side, differs


def compact(record, active: mi.Bool):
    """The lanes of `record` (a dataclass of arrays) that are active. Evaluates.

    All fields are evaluated in one kernel first: a gather from pending arrays would launch one for each.
    """
    dr.eval(record, active)
    return dr.gather(type(record), record, dr.compress(active))
