"""Edges that no path can reach, because they lie inside of another solid body: the sunk part of a box.

A body counts if it is closed, convex and opaque, and nothing inside of it sees or shines: then no path gets into it,
and an edge whose ends are both inside is inside as a whole. A convex body is the part of space behind all its faces.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_faces, mesh_positions
from ..core.sensor_frame import origin_box
from ..core.varying import varying
from ..plan.job import Job
from ..scene.facts import EmitterFacts, ShapeFacts
from .convexity import is_convex_body
from .edge_shapes import edge_shapes
from .overlaps import apart, box_of
from .rows import EdgeRows

#: Faces of a body up to which edges are looked for inside of it: each edge is compared with each of its faces.
MAX_FACES = 64

#: Depth below the faces, relative to the extent of the body and to the largest coordinate, beyond rounding.
DEPTH, ROUNDING = 1e-4, 1e-6


def buried(job: Job, rows: EdgeRows, bodies: list[ShapeFacts]) -> mi.Bool | None:
    """Rows that lie inside of one of `bodies`. None if none of these can hide anything."""
    if not bodies:
        return None
    found, shapes = None, edge_shapes(job).shapes
    starts = [origin_box(job.frame), *(_place(job, k, e) for k, e in enumerate(job.facts.emitters) if not e.infinite)]
    lonely = _lonely([box_of(shape) for shape in shapes])
    for body in bodies:
        if not lonely[body.index] and _may_hide(job, body, starts):
            inside = _is_inside(shapes[body.index], body, rows, job.facts.reach)
            found = inside if found is None else found | inside
            dr.eval(found)  # body by body in one kernel: together they would be one for every number of them
    return found


def _lonely(boxes: list[np.ndarray]) -> np.ndarray:
    """By shape with such a bounding box: is it apart from all others?"""
    lower, upper = np.stack(boxes, axis=1)
    meets = ((lower[:, None] <= upper[None]) & (upper[:, None] >= lower[None])).all(-1)
    return meets.sum(1) == 1


def _may_hide(job: Job, body: ShapeFacts, starts: list[tuple]) -> bool:
    """Is this a body that no path gets into? `starts`: boxes in which they begin."""
    shape = edge_shapes(job).shapes[body.index]
    small = body.plugin == "sphere" or (body.is_mesh and body.faces <= MAX_FACES)
    if not body.opaque or body.is_emitter or body.has_medium or not small:
        return False
    outside = all(apart(*start, shape.bbox()) for start in starts)
    return outside and is_convex_body(shape, body, job.call.memory)


def _place(job: Job, index: int, facts: EmitterFacts) -> tuple:
    """Lower and upper corner of a box around a light; of the whole scene if its place is not known."""
    box = job.scene.emitters()[index].bbox()
    if facts.shape >= 0:
        owner = job.facts.shapes[facts.shape].index
        box = edge_shapes(job).shapes[owner].bbox() if owner >= 0 else job.scene.bbox()
    elif not box.valid():  # of a projector
        box = job.scene.bbox()
    return box.min, box.max


def _is_inside(shape: mi.Shape, facts: ShapeFacts, rows: EdgeRows, reach: float) -> mi.Bool:
    """Are both ends of an edge well inside of a convex body?"""
    box = shape.bbox()
    depth = varying(mi.Float, DEPTH * float(dr.norm(box.extents())) + ROUNDING * reach)
    if facts.plugin == "sphere":
        centre = varying(mi.Point3f, list(box.center()))
        radius = varying(mi.Float, float(box.extents().x) / 2)
        return dr.maximum(dr.norm(rows.p0 - centre), dr.norm(rows.p1 - centre)) < radius - depth
    positions, faces = dr.detach(mesh_positions(shape)), mesh_faces(shape)
    a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in (faces.x, faces.y, faces.z))
    n = dr.normalize(dr.cross(b - a, c - a))
    offset = dr.dot(n, a) - depth
    dr.eval(n, offset)
    return _behind_all(n, offset, rows.p0, rows.p1)


@dr.syntax
def _behind_all(n: mi.Vector3f, offset: mi.Float, a: mi.Point3f, b: mi.Point3f) -> mi.Bool:
    """Do points lie behind all planes n·x = offset? In one kernel, however many planes there are."""
    k, count = mi.UInt32(0), varying(mi.UInt32, dr.width(offset))
    inside = dr.full(mi.UInt32, 1, dr.width(a))
    while dr.hint((k < count) & (inside != 0), label="psdr.buried"):
        n_k = dr.gather(type(n), n, k)
        farthest = dr.maximum(dr.dot(n_k, a), dr.dot(n_k, b))
        inside = dr.select(farthest < dr.gather(mi.Float, offset, k), inside, 0)
        k += 1
    return inside != 0
