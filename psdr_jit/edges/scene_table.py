"""The edge table of a scene: which shapes give which kinds of edges, and what of them is left out at once.

A new kind of edge enters here, in `edge_table`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_buffers, same_values
from ..core.memory import Slot
from ..core.sensor_frame import origin_box
from ..core.upload import uploaded
from ..core.varying import varying
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.facts import ShapeFacts
from ..scene.grids import ALIKE, bent_degrees
from ..scene.registry import registry_table
from ..scene.tangent_facts import vertex_speeds
from .buried import buried
from .capped import joined_rims
from .coarse import BENT, COARSE, COARSE_UNDER_SKY, warn_about_coarse
from .contact_limits import touching, warn_about_contacts
from .contact_motion import warn_about_parting
from .curves import CURVES_OF, PIECES, curve_set
from .edge_shapes import edge_shapes
from .grid_set import GridSet
from .junctions import JunctionRows
from .kind import EdgeKind
from .kind_analytic import AnalyticCurves
from .kind_ellipsoid import EllipsoidOutlines, warn_about_touching
from .kind_grid import GridEdges
from .kind_grid_shading import GridShadingOutlines
from .kind_junction import Junctions
from .kind_mesh import MeshEdges
from .kind_mirror_horizon import MirrorHorizons, lets_through, reflects
from .kind_rod import RodEdges
from .kind_shading import ShadingOutlines
from .kind_tube import TubeOutlines, tube_rows
from .overlaps import apart, box_of, crossing, warn_about_pairs
from .rod_rows import rod_rows
from .rows import EdgeRows
from .scene_bent import bent_kinds
from .scene_grids import scene_grids
from .scene_patterns import pattern_kinds, patterns_of
from .segments import EdgeSet, edge_set
from .smooth_faces import smooth_faces
from .solids import Ball, Drum
from .standing_rims import standing, warn_about_lifted_rims
from .table import EdgeTable

#: Of one render call: the table.
TABLE: Slot[EdgeTable | None] = Slot(lambda: None)

#: Of an integrator: the arrays that straight edges were made from last, which meshes could move and which were
#: painted, and these edges.
STRAIGHT: Slot[tuple[list, tuple[list[bool], list[bool]], EdgeSet] | None] = Slot(lambda: None)

#: Angle between blended normals of a grid and its surface [degrees] from which what has no edge is worth a warning.
COARSE_GRID = 10.0

#: Bodies whose curves with meshes are looked for.
ROUND = {"sphere": Ball, "cylinder": Drum}


def scene_edges(job: Job) -> EdgeTable:
    """Edges of all shapes, built once per render call; mesh topologies outlive it."""
    if job.shared[TABLE] is None:
        job.shared[TABLE] = edge_table(job)
    warn_about_contacts(job, job.shared[TABLE].touching)
    return job.shared[TABLE]


def edge_table(job: Job) -> EdgeTable:
    """All edges of the scene, those that no path can reach left out."""
    shapes, chosen = edge_shapes(job).shapes, edge_shapes(job).facts
    meshes, analytic = [s for s in chosen if s.is_mesh], [s for s in chosen if s.plugin in CURVES_OF]
    bodies = [(shapes[s.index], s.plugin) for s in chosen]
    bodies += [(place, place.facts.plugin) for place in edge_shapes(job).grids]
    pairs = crossing([box_of(body) for body, _ in bodies])
    warn_about_pairs(bodies, pairs, job.call.memory)
    overlapping = [chosen[k] for k in sorted({k for pair in pairs for k in pair}) if k < len(chosen)]
    centre = varying(mi.Point3f, list(job.scene.bbox().center()))
    balls = tuple(ROUND[s.plugin](shapes[s.index], s.moves) for s in analytic if s.plugin in ROUND)
    straight = _edge_set(job, meshes, balls)
    warn_about_parting(job, straight.contacts)
    warn_about_lifted_rims(job, shapes, chosen)
    kinds, hidden = _between_faces(job, straight, meshes, overlapping, centre)
    curves = _analytic(job, analytic, centre)
    if curves is not None:
        kinds.append(curves)
    if job.surfaces is not None and job.surfaces.splines is not None:
        kinds.append(TubeOutlines(job.surfaces.splines, tube_rows(job.surfaces.splines), centre))
    if job.surfaces is not None and job.surfaces.rods is not None:
        kinds.append(RodEdges(job.surfaces.rods, rod_rows(job.surfaces.rods), centre))
    if job.surfaces is not None and job.surfaces.ellipsoids is not None:
        kinds.append(EllipsoidOutlines(job.surfaces.ellipsoids, centre))
        warn_about_touching(job.surfaces.ellipsoids, job.call.memory)
    grids = scene_grids(job)
    if grids is not None:
        kinds += _grid_edges(job, grids, centre)
    kinds += _shading_outlines(job, meshes, centre)
    kinds += pattern_kinds(job, meshes, analytic, centre)
    kinds += bent_kinds(job, meshes, analytic, centre)
    on_rims = standing(shapes, chosen) if job.options.form == "material" else []
    contacts = touching(straight, on_rims, job.facts.camera_moves, job.call.memory)
    return EdgeTable(tuple(kinds), hidden, contacts)


def _edge_set(job: Job, meshes: list[ShapeFacts], balls: tuple[Ball | Drum, ...]) -> EdgeSet:
    """Edges of the meshes; kept from call to call while these stay as they are: views of one scene share them."""
    shapes = [edge_shapes(job).shapes[s.index] for s in meshes]
    moving, painted = [s.moves for s in meshes], [s.painted for s in meshes]
    seams = [None if p is None else p.on_sides for p in patterns_of(job, meshes)]
    if balls or not job.plan.prunes:
        return edge_set(shapes, moving, job.call.memory, balls, seams, painted)
    buffers = [dr.detach(buffer) for shape in shapes for buffer in mesh_buffers(shape)]
    buffers += [on_sides for on_sides in seams if on_sides is not None]
    known = job.call.memory[STRAIGHT]
    if known is not None and known[1] == (moving, painted) and _same(known[0], buffers):
        straight = known[2]
    else:
        straight = edge_set(shapes, moving, job.call.memory, seams=seams, painted=painted)
    job.call.memory[STRAIGHT] = (buffers, (moving, painted), straight)
    return replace(straight, meshes=tuple(shapes))


def _same(kept: list, buffers: list) -> bool:
    """Do these arrays hold what the kept ones do? Positions that are assigned anew in every call, to attach them, are
    other arrays of the same content, and edges take longer to find than to compare.
    """
    return len(kept) == len(buffers) and all(same_values(a, b) for a, b in zip(kept, buffers, strict=True))


def _between_faces(
    job: Job, found: EdgeSet, meshes: list[ShapeFacts], bodies: list[ShapeFacts], centre: mi.Point3f
) -> tuple[list[EdgeKind], int]:
    """Edges of meshes and junctions as kinds, and how many of them lie inside of other `bodies`."""
    if found.rows is None:
        return [], 0
    outside = _seen_from_outside(job, meshes)
    rows, _, hidden = _reachable(job, found.rows, bodies)
    kinds: list[EdgeKind] = []
    if rows is not None:
        # not in place: the arrays may be those that are kept
        rows = _as_seen(rows, outside)
        if job.options.direction == "known" and job.plan.prunes:
            speed = vertex_speeds(found.meshes)
            speed = speed if found.between is None else found.between.added_to(speed)
            rows.moves = rows.moves & (sum(dr.gather(mi.Float, speed, v) for v in (rows.v0, rows.v1)) > 0)
        kinds.append(MeshEdges(found.meshes, rows, found.shapes, centre, found.between))
    if found.junctions is not None:
        rows, index, count = _reachable(job, found.junctions.edges, bodies)
        hidden += count
        if rows is not None:
            curves = found.junctions.rows
            through = _looked_through(job, curves, index)
            kinds.append(Junctions(_as_seen(rows, outside), index, curves, centre, job.surfaces, through))
    dr.eval([kind.rows for kind in kinds])  # now, not with the term that needs them first: its kernels would differ
    return kinds, hidden


def _as_seen(rows: EdgeRows, outside: mi.Float) -> EdgeRows:
    """The rows, with shells that only count where paths meet the outer side alone."""
    rows = copy(rows)
    rows.shell0 = rows.shell0 * dr.gather(mi.Float, outside, rows.shape0)
    rows.shell1 = rows.shell1 * dr.gather(mi.Float, outside, rows.shape1)
    return rows


def _seen_from_outside(job: Job, meshes: list[ShapeFacts]) -> mi.Float:
    """1 for every mesh of which light paths from the sensor meet the outer side only, if it is closed; else 0.

    Paths do not enter a closed opaque shape; they may start in it, and pass through lights that are hidden.
    """
    lower, upper = origin_box(job.frame)
    flags = []
    for facts in meshes:
        outside = apart(lower, upper, edge_shapes(job).shapes[facts.index].bbox())
        flags.append(float(facts.opaque and outside and not _is_hidden(job, facts)))
    return mi.Float(flags)


def _is_hidden(job: Job, facts: ShapeFacts) -> bool:
    """Does the sensor look through it?"""
    return facts.is_emitter and job.options.hide_emitters


def _looked_through(job: Job, curves: JunctionRows, index: mi.UInt32) -> mi.Bool:
    """By row: does one of the surfaces at the curve `index` belong to a light that the sensor looks through?"""
    hidden = registry_table(job.scene, {facts.index for facts in job.facts.shapes if _is_hidden(job, facts)})
    shapes = (dr.gather(mi.UInt32, sheet.shape, index) for sheet in (curves.a, curves.b))
    through = sum(dr.gather(mi.UInt32, hidden, shape) for shape in shapes) > 0
    dr.eval(through)
    return through


def _reachable(job: Job, rows: EdgeRows, bodies: list[ShapeFacts]) -> tuple[EdgeRows | None, mi.UInt32, int]:
    """Edges that a path may reach, their rows, and how many others there are; None if there are only others."""
    total = dr.width(rows.v0)
    everything = dr.arange(mi.UInt32, total)
    if not job.plan.prunes:
        return rows, everything, 0
    hidden = buried(job, rows, bodies)
    count = 0 if hidden is None else int(dr.count(hidden)[0])
    if count == 0:
        return rows, everything, 0
    if count == total:
        return None, everything, count
    dr.eval(rows, hidden)
    kept = dr.compress(~hidden)
    return dr.gather(EdgeRows, rows, kept), kept, count


def _shading_outlines(job: Job, meshes: list[ShapeFacts], centre: mi.Point3f) -> list[EdgeKind]:
    """Where interpolated normals turn away, on the meshes that are shaded with them."""
    meshes = [s for s in meshes if s.smooth]
    if not meshes:
        return []
    shapes = [edge_shapes(job).shapes[s.index] for s in meshes]
    faces = smooth_faces(shapes, [s.moves for s in meshes], _seen_from_outside(job, meshes), job.call.memory)
    if job.options.depth_limit > 2 or any(not e.delta for e in job.facts.emitters):  # surfaces are lights as well
        limit = COARSE if job.scene.environment() is None else COARSE_UNDER_SKY
        # Towards a point of light or from one, a whole face turns at once: what others see of that is not sampled.
        flips = job.facts.has_delta_emitters and job.options.depth_limit > 2
        smooth = list(zip(shapes, meshes, strict=True))
        sends = [shape for shape, s in smooth if not s.is_emitter and (lets_through(shape) or flips)]
        warn_about_coarse(sends, limit, job.call.memory)
        others = [shape for shape, s in smooth if s.delta_lobes or _lets_light_in(job, shape)]
        warn_about_coarse(others, COARSE, job.call.memory)
    return [ShadingOutlines(faces, centre), *_mirror_horizons(job, meshes, centre)]


def _mirror_horizons(job: Job, meshes: list[ShapeFacts], centre: mi.Point3f) -> list[EdgeKind]:
    """Where smooth-shaded meshes begin to reflect under their own faces."""
    shapes = edge_shapes(job).shapes
    mirrors = [s for s in meshes if reflects(shapes[s.index])]
    if job.options.depth_limit < 2 or not mirrors:
        return []
    outside = _seen_from_outside(job, mirrors)
    faces = smooth_faces([shapes[s.index] for s in mirrors], [s.moves for s in mirrors], outside, job.call.memory)
    return [MirrorHorizons(replace(faces, again=True), centre)]


def _lets_light_in(job: Job, mesh: mi.Mesh) -> bool:
    """Do paths go on inside? What is scattered below a face's plane gets in, and back out after another vertex."""
    return job.options.depth_limit > 3 and mi.has_flag(mesh.bsdf().flags(), mi.BSDFFlags.BackSide)


def _grid_edges(job: Job, grids: GridSet, centre: mi.Point3f) -> list[EdgeKind]:
    """Of grids of signed distances: edges, and where blended normals turn away.

    What a surface hides from its own points changes from cell to cell, however it is shaded. Where normals are bent
    far enough, creases count as steps for that. No horizon stands for it (`horizons`).
    """
    bent = [bent_degrees(place.shape, job.call.memory) for place in grids.places]
    for place, degrees in zip(grids.places, bent, strict=True):
        if degrees > COARSE_GRID:
            warn_once(
                f"SDF grid '{place.shape.id()}' is shaded with blended normals that are up to {degrees:.0f} degrees "
                "off its surface: where it turns from a light, a step of what it reflects is missing from the "
                "derivative, some 2 % of it at 15 degrees; set normals to 'analytic', or use a finer grid",
                UnsupportedWarning, job.call.memory,
            )  # fmt: skip
    steps = [not ALIKE < degrees <= BENT for degrees in bent]
    outlines = GridShadingOutlines.of(grids, job.call.memory, centre)
    edges = GridEdges(grids, uploaded(mi.UInt32, np.array(steps)), centre)
    return [edges] if outlines is None else [edges, outlines]


def _analytic(job: Job, analytic: list[ShapeFacts], centre: mi.Point3f) -> AnalyticCurves | None:
    """Outlines and rims of the shapes without triangles."""
    shapes = edge_shapes(job).shapes
    curves = curve_set([(shapes[s.index], s.plugin) for s in analytic])
    if curves.rows is None:
        return None
    moves = np.concatenate([np.full(len(CURVES_OF[s.plugin]) * PIECES, s.moves) for s in analytic])
    closed, closing = joined_rims(curves, [s.plugin for s in analytic], [s.moves for s in analytic])
    return AnalyticCurves(curves, *(uploaded(mi.Bool, column) for column in (moves, closed, closing)), centre)
