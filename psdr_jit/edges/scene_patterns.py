"""The patterns of a scene as kinds of edges.

Which lines cross which patches depends on texture coordinates and textures alone: it is kept while shapes move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, same_values, texcoords_buffer
from ..core.joining import pointers
from ..core.memory import Memory, Slot
from ..core.upload import uploaded
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.curve_ends import SEGMENTS
from ..scene.facts import ShapeFacts
from ..scene.patterns import (
    StepFamily,
    pattern_textures,
    pattern_textures_on_curve,
    step_families,
    steps_between_faces,
    texture_values,
)
from .curve_pattern_rows import curve_patterns
from .edge_shapes import edge_shapes
from .joined_meshes import attached_positions
from .kind import EdgeKind
from .kind_curve_pattern import RodPatterns, TubePatterns
from .kind_pattern import AnalyticPatterns, MeshPatterns
from .pattern_rows import MOST_LINES, PatternSet, pattern_set, too_fine
from .pattern_shapes import ShapePatterns, analytic_patterns, mesh_patterns, texture_reach
from .seen_sides import seen_sides


@dataclass(frozen=True)
class _Known:
    """The patterns of a shape, and what they were made from, kept alive so that it can be told from something else."""

    values: list  # textures and their parameters
    buffers: list  # texture coordinates and faces of a mesh, segments of a curve
    families: list[StepFamily]
    between_faces: bool
    patterns: ShapePatterns


@dataclass(frozen=True)
class _Table:
    """Patterns of several shapes in one table."""

    found: list[ShapePatterns | None]
    offsets: list[int]  # of their vertices, or segments
    lines: PatternSet | None


#: Of an integrator: patterns by name of the shape.
PATTERNS: Slot[dict[str, _Known]] = Slot(dict)

#: Of an integrator: the tables last made, by family of shapes.
TABLES: Slot[dict[str, _Table]] = Slot(dict)

MESH, ANALYTIC = "mesh", "analytic"


def patterns_of(job: Job, chosen: list[ShapeFacts]) -> list[ShapePatterns | None]:
    """The patterns of shapes, None for those without; kept from call to call."""
    return [_shape_patterns(job, facts).patterns if facts.patterns else None for facts in chosen]


def steps_of(job: Job, facts: ShapeFacts) -> tuple[list[StepFamily], bool]:
    """The lines along which a shape with patterns steps, and whether its faces differ; kept from call to call."""
    known = _shape_patterns(job, facts)
    return known.families, known.between_faces


def pattern_kinds(
    job: Job, meshes: list[ShapeFacts], analytic: list[ShapeFacts], centre: mi.Point3f
) -> tuple[EdgeKind, ...]:
    """The patterns of all shapes as kinds of edges; none where there are no lines."""
    kinds: list[EdgeKind] = []
    for chosen, family in ((meshes, MESH), (analytic, ANALYTIC)):
        if not any(facts.patterns for facts in chosen):
            continue
        shapes, found = [edge_shapes(job).shapes[facts.index] for facts in chosen], patterns_of(job, chosen)
        lines = _lines(job.call.memory, found, [s.vertex_count() if s.is_mesh() else 0 for s in shapes], family)
        if lines is None:
            continue
        moves = _moves(chosen, lines)
        fronts = [0.0 if patterns is None else patterns.front for patterns in found]
        front, back = seen_sides(job, chosen, fronts, lines.rows.shape, lines.rows.part)
        common = (pointers(mi.ShapePtr, shapes), centre, tuple(shapes))
        if family == MESH:
            positions = dr.detach(attached_positions(tuple(shapes)))
            dr.eval(moves, front, back, positions)
            kinds.append(MeshPatterns(lines, moves, front, back, *common, positions))
        else:
            closed, either = back == 0, dr.full(mi.Float, 1, dr.width(moves))
            dr.eval(moves, closed)
            kinds.append(AnalyticPatterns(lines, moves, either, either, *common, closed))
    return (*kinds, *_on_curves(job, centre))


def _on_curves(job: Job, centre: mi.Point3f) -> list[EdgeKind]:
    """The patterns of B-spline and linear curves."""
    kinds: list[EdgeKind] = []
    if job.surfaces is None:
        return kinds
    for segments, plugin, kind in (
        (job.surfaces.splines, "bsplinecurve", TubePatterns), (job.surfaces.rods, "linearcurve", RodPatterns)
    ):  # fmt: skip
        chosen = [facts for facts in edge_shapes(job).facts if facts.kind == "curve" and facts.plugin == plugin]
        if segments is None or not any(facts.patterns for facts in chosen):
            continue
        counts = [shape.primitive_count() for shape in segments.shapes]
        lines = _lines(job.call.memory, patterns_of(job, chosen), counts, plugin)
        if lines is not None:
            moves = _moves(chosen, lines)
            either = dr.full(mi.Float, 1, dr.width(moves))
            dr.eval(moves)
            kinds.append(kind(lines, moves, either, either, segments.pointers, centre, segments.shapes, segments))
    return kinds


def _moves(chosen: list[ShapeFacts], lines: PatternSet) -> mi.Bool:
    """By row: can its shape move?"""
    return dr.gather(mi.Bool, uploaded(mi.Bool, np.array([facts.moves for facts in chosen])), lines.rows.shape)


def _shape_patterns(job: Job, facts: ShapeFacts) -> _Known:
    shape, known = edge_shapes(job).shapes[facts.index], job.call.memory[PATTERNS].get(facts.name)
    is_curve = facts.kind == "curve"
    textures = pattern_textures_on_curve(shape) if is_curve else pattern_textures(shape)
    values: list[Any] = [*textures, *(dr.detach(value) for value in texture_values(textures))]
    buffers = [dr.detach(texcoords_buffer(shape)), faces_buffer(shape)] if facts.is_mesh else []
    buffers += [mi.traverse(shape)[SEGMENTS]] if is_curve else []
    if known is None or not _unchanged(known, values, buffers):
        families, between_faces = _families(textures, shape, facts, job.call.memory), steps_between_faces(textures)
        if facts.is_mesh:
            patterns = mesh_patterns(shape, families, between_faces)
        elif is_curve:
            patterns = curve_patterns(shape, facts.plugin, families)
        else:
            patterns = analytic_patterns(facts.plugin, families)
        known = _Known(values, buffers, families, between_faces, patterns)
        job.call.memory[PATTERNS][facts.name] = known
    return known


def _unchanged(known: _Known, values: list, buffers: list) -> bool:
    """A rectangle that moves gets new buffers of the same content."""
    same = same_parameters(known.values, values)
    return same and all(same_values(a, b) for a, b in zip(known.buffers, buffers, strict=True))


def same_parameters(known: list, values: list) -> bool:
    """Are textures and what was found in them the same objects and arrays? The `known` ones must be alive."""
    return [_identity(v) for v in known] == [_identity(v) for v in values]


def _identity(value: Any) -> Any:
    """Equal for two values if they are the same object or array; the other one must be alive."""
    if isinstance(value, mi.Object):
        return id(value)
    if not dr.is_array_v(value):
        return np.array(value.matrix).tobytes() if hasattr(value, "matrix") else value
    if dr.is_tensor_v(value):
        return value.array.index
    if dr.depth_v(value) > 1:
        return tuple(_identity(component) for component in value)
    return value.index if dr.is_jit_v(value) else value


def _families(textures: list[mi.Texture], shape: mi.Shape, facts: ShapeFacts, memory: Memory) -> list[StepFamily]:
    """The lines of `textures`, but for those that are too many on `shape`."""
    families, reach = [family for texture in textures for family in step_families(texture)], texture_reach(shape)
    kept = [family for family in families if not too_fine(family, reach)]
    if len(kept) < len(families):
        message = (f"shape '{facts.name}' has more than {MOST_LINES} parallel steps inside its surface "
                   f"({', '.join(facts.patterns)}): their part of the derivative is missing; use a smaller to_uv, or "
                   "the mean colour")  # fmt: skip
        warn_once(message, UnsupportedWarning, memory)
    return kept


def _lines(memory: Memory, found: list[ShapePatterns | None], counts: list[int], family: str) -> PatternSet | None:
    """The lines of several shapes, of `counts` vertices or segments, in one table, kept while they are the same."""
    offsets = [sum(counts[:k]) for k in range(len(counts))]
    known = memory[TABLES].get(family)
    if known is None or known.offsets != offsets or any(a is not b for a, b in zip(known.found, found, strict=True)):
        parts = []
        for k, patterns in enumerate(found):
            for lines, rows in patterns.parts if patterns is not None else ():
                corners = {v: rows[v] + offsets[k] for v in ("v0", "v1", "v2")}
                parts.append((lines, {**rows, **corners, "shape": np.full(len(rows["line"]), k)}))
        known = _Table(found, offsets, pattern_set(parts))
        if known.lines is not None:
            dr.eval(known.lines.rows, known.lines.s, known.lines.inset)
        memory[TABLES][family] = known
    return known.lines
