"""From which side the parts of shapes may be looked at."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import joined
from ..core.sensor_frame import origin_box
from ..core.upload import uploaded
from ..plan.job import Job
from ..scene.facts import ShapeFacts
from .edge_shapes import edge_shapes
from .overlaps import apart
from .segments import known_topology


def seen_sides(
    job: Job, chosen: list[ShapeFacts], fronts: list[float], shape: mi.UInt32, part: mi.UInt32
) -> tuple[mi.Float, mi.Float]:
    """By row: can the side of the face that its winding calls the front be seen at all, and the other? 0 or 1.

    Not the inner side of a closed opaque shape that nobody is in, nor the back of a one-sided material; nothing of
    faces that repeat others. `shape`, `part`: by row, index among the `chosen` shapes and face of a mesh; `fronts`, by
    shape: `pattern_shapes.winding` of a mesh.
    """
    lower, upper = origin_box(job.frame)
    shapes, sides, shells, firsts, first = edge_shapes(job).shapes, [], [], [], 0
    topologies = [known_topology(shapes[s.index], job.call.memory) if s.is_mesh else None for s in chosen]
    for facts, front, topology in zip(chosen, fronts, topologies, strict=True):
        outside = float(facts.opaque and apart(lower, upper, shapes[facts.index].bbox()))
        one_sided = facts.is_mesh and not facts.smooth and not facts.bsdf_flags & int(mi.BSDFFlags.BackSide)
        sides.append(front if one_sided else 0.0)
        shells.append(outside * (topology.facing if topology else mi.Float(facts.plugin == "sphere")))
        firsts.append(first)
        first += facts.faces if facts.is_mesh else 1
    face = dr.gather(mi.UInt32, uploaded(mi.UInt32, np.array(firsts)), shape)
    place = face + part if any(facts.is_mesh for facts in chosen) else face
    closed = dr.gather(mi.Float, joined(shells), place)
    there = mi.Bool(True)
    if not all(topology is None or topology.keeps_all for topology in topologies):
        there = dr.gather(mi.Bool, joined([t.kept if t else mi.Bool(True) for t in topologies]), place)
    side = dr.gather(mi.Float, uploaded(mi.Float, np.array(sides)), shape)
    front = dr.select((closed < 0) | (side < 0) | ~there, mi.Float(0), 1)
    return front, dr.select((closed > 0) | (side > 0) | ~there, mi.Float(0), 1)
