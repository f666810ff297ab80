"""The bump and normal maps of a scene as kinds of edges."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.joining import pointers
from ..plan.job import Job
from ..scene.bent_normals import bent_maps
from ..scene.facts import ShapeFacts
from .bent_rows import bent_rows
from .bent_seen import SeenPatches
from .bent_surface import BentBodies, BentMeshes
from .edge_shapes import edge_shapes
from .joined_meshes import attached_positions
from .kind import EdgeKind
from .kind_bent import BentOutlines
from .seen_sides import seen_sides


def bent_kinds(job: Job, meshes: list[ShapeFacts], analytic: list[ShapeFacts], centre: mi.Point3f) -> list[EdgeKind]:
    """Where bent normals of these shapes turn from viewers; none where nothing is bent, or nothing scatters."""
    kinds: list[EdgeKind] = []
    shapes = edge_shapes(job).shapes
    for family in (meshes, analytic):
        chosen = [facts for facts in family if facts.sees_frame and bent_maps(shapes[facts.index].bsdf())]
        if job.options.depth_limit < 2 or not chosen:
            continue
        own = tuple(shapes[facts.index] for facts in chosen)
        rows, maps, fronts = bent_rows(list(zip(own, chosen, strict=True)), job.call.memory)
        front, back = seen_sides(job, chosen, fronts, rows.shape, rows.part)
        rows = replace(rows, front=rows.front & (front > 0), back=rows.back & (back > 0))  # not in place: it is kept
        common = (maps, pointers(mi.ShapePtr, own), own)
        if family is meshes:
            surface = BentMeshes(*common, dr.detach(attached_positions(own)))
            dr.eval(surface.positions)
        else:
            surface = BentBodies(*common)
        dr.eval(rows)
        kinds.append(BentOutlines(rows, surface, SeenPatches(rows, surface, job.frame), centre))
    return kinds
