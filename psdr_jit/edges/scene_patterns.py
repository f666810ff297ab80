"""The patterns of a scene: patches of its shapes, the lines on them, and the kinds that these make.

Lines and patches depend on texture coordinates and textures alone, so they are kept while shapes move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, mesh_faces, mesh_positions, same_values, texcoords_buffer
from ..core.memory import Memory, Slot
from ..core.sensor_frame import origin_box
from ..core.upload import uploaded
from ..plan.job import Job
from ..scene.facts import ShapeFacts
from ..scene.patterns import StepFamily, pattern_textures, step_families, steps_between_faces, texture_values
from .kind import EdgeKind
from .kind_pattern import AnalyticPatterns, MeshPatterns, Surface
from .overlaps import apart
from .pattern_rows import End, Lines, Patches, PatternSet, parallel_lines, pattern_set, rows_on, sides_on_lines
from .segments import TOPOLOGIES, attached_positions

#: Patches of a mesh at least: large faces are divided, so that parts that are near or hidden get their own weight.
LEAST_PATCHES = 512

#: Patches along both texture coordinates of a shape without triangles.
ANALYTIC_GRID = {"sphere": (32, 16), "cylinder": (32, 16), "disk": (16, 32)}

SURFACES = {"disk": Surface.DISK, "cylinder": Surface.CYLINDER, "sphere": Surface.SPHERE}

U, V = np.array([1.0, 0.0]), np.array([0.0, 1.0])

#: Where the texture coordinates of shapes without triangles end.
ENDS = {
    "disk": (End(U, 0.0, False), End(U, 1.0, False), End(V, 0.0, True), End(V, 1.0, False)),
    "cylinder": (End(U, 0.0, True), End(U, 1.0, False), End(V, 0.0, False), End(V, 1.0, False)),
    "sphere": (End(U, 0.0, True), End(U, 1.0, False), End(V, 0.0, False), End(V, 1.0, False)),
}


@dataclass(frozen=True)
class ShapePatterns:
    """The pattern of one shape, from what `values` were."""

    values: list  # textures and their parameters, kept alive so that they can be told from others
    buffers: list  # texture coordinates and faces of a mesh
    parts: list[tuple[Lines, dict[str, np.ndarray]]]  # but for the columns that depend on other shapes
    on_sides: mi.Bool | None  # of a mesh, by 3 · face + corner: is there a step along the side opposite to it?
    side: float  # +1: its front is where the normals of its faces by their winding are; −1: the other side; 0: unknown


#: Corners of a face in its own coordinates, which are those of a texture on a mesh without any.
BARYCENTRIC = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

#: Ratio of the widths of a face in texture coordinates below which it has no area there.
FLAT = 1e-6

#: Of an integrator: patterns by name of the shape.
PATTERNS: Slot[dict[str, ShapePatterns]] = Slot(dict)

#: Of an integrator: the patterns of meshes, and of other shapes, that were last put together.
TABLES: Slot[dict[bool, tuple[list, list[int], PatternSet | None]]] = Slot(dict)


def patterns_of(job: Job, chosen: list[ShapeFacts]) -> list[ShapePatterns | None]:
    """The patterns of shapes, None for those without; kept from call to call."""
    return [_shape_patterns(job, facts) if facts.patterns else None for facts in chosen]


def _shape_patterns(job: Job, facts: ShapeFacts) -> ShapePatterns:
    shape, known = job.scene.shapes()[facts.index], job.call.memory[PATTERNS].get(facts.name)
    if known is not None and dr.flag(dr.JitFlag.FreezingScope):  # values cannot be read, and must not be others
        return known
    textures = pattern_textures(shape)
    values: list[Any] = [*textures, *(dr.detach(value) for value in texture_values(textures))]
    buffers = [dr.detach(texcoords_buffer(shape)), faces_buffer(shape)] if facts.is_mesh else []
    if known is None or not _unchanged(known, values, buffers):
        families = [family for texture in textures for family in step_families(texture)]
        if facts.is_mesh:
            found = _mesh_patterns(shape, families, steps_between_faces(textures))
        else:
            found = (*_analytic_patterns(facts.plugin, families), 1.0)
        known = ShapePatterns(values, buffers, *found)
        job.call.memory[PATTERNS][facts.name] = known
    return known


def _unchanged(known: ShapePatterns, values: list, buffers: list) -> bool:
    """A rectangle that moves gets new buffers of the same content."""
    same = [_identity(v) for v in known.values] == [_identity(v) for v in values]
    return same and all(same_values(a, b) for a, b in zip(known.buffers, buffers, strict=True))


def _identity(value: Any) -> Any:
    """Equal for two values if they are the same object or array; the other one must be alive."""
    if hasattr(value, "matrix"):
        return np.array(value.matrix).tobytes()
    if dr.is_tensor_v(value):
        return value.array.index
    if dr.is_array_v(value) and dr.depth_v(value) > 1:
        return tuple(_identity(component) for component in value)
    return value.index if dr.is_jit_v(value) else id(value) if isinstance(value, mi.Object) else value


def _mesh_patterns(mesh: mi.Mesh, families: list[StepFamily], everywhere: bool) -> tuple:
    """Columns `parts`, `on_sides` and `side` of `ShapePatterns`; `everywhere`: all edges may be steps."""
    faces = np.array(mesh_faces(mesh)).T
    if mesh.has_vertex_texcoords():
        uv = np.array(dr.detach(texcoords_buffer(mesh)), float).reshape(-1, 2)[faces]
    else:  # Mitsuba takes the barycentric coordinates of every face
        uv = np.broadcast_to(BARYCENTRIC, (len(faces), 3, 2))
        everywhere |= len(families) > 0
    found = parallel_lines(families, uv.reshape(-1, 2))
    patches = _face_patches(uv)
    # q = (uv − uv_0) J⁻¹; the pseudo-inverse where a face has no area in texture coordinates
    inverse = np.linalg.pinv(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], 1), rcond=FLAT)
    parts = []
    for lines in found:
        rows = rows_on(patches, uv, lines, (lines.n @ inverse)[patches.part])
        rows |= {f"v{i}": faces[rows["part"], i] for i in range(3)}
        parts.append((lines, rows))
    on_sides = np.full((len(faces), 3), True) if everywhere else sides_on_lines(uv, found)
    on_device = uploaded(mi.Bool, on_sides) if on_sides.any() else None
    return parts, on_device, _front(mesh)


def _face_patches(uv: np.ndarray) -> Patches:
    """Faces with texture coordinates (F, 3, 2), each cut into n² triangles."""
    n = max(1, int(np.ceil(np.sqrt(LEAST_PATCHES / max(len(uv), 1)))))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    lower, upper = i + j < n, i + j < n - 1
    corner = np.stack([i, j], 1)
    cut = np.concatenate([
        (corner[:, None] + np.array([[0, 0], [1, 0], [0, 1]]))[lower],
        (corner[:, None] + np.array([[1, 1], [0, 1], [1, 0]]))[upper],
    ])  # fmt: skip
    # whole numbers over n: what patches share is the same number in both
    q = np.tile(cut / n, (len(uv), 1, 1))
    part = np.repeat(np.arange(len(uv)), len(cut))
    at, b = uv[part], q[:, :, :, None]
    return Patches(at[:, None, 0] + b[:, :, 0] * (at[:, None, 1] - at[:, None, 0])
                   + b[:, :, 1] * (at[:, None, 2] - at[:, None, 0]), q, part)  # fmt: skip


def _front(mesh: mi.Mesh) -> float:
    """On which side of its faces, by their winding, the normals of a mesh are: +1 or −1; 0 if that is not known."""
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.t, pi.prim_uv, pi.valid = mi.Float(0), mi.Point2f(1 / 3), mi.Bool(True)
    pi.shape = mi.ShapePtr(mesh)
    corners = dr.gather(mi.Vector3u, mesh_faces(mesh), 0)
    p0, p1, p2 = (dr.gather(mi.Point3f, dr.detach(mesh_positions(mesh)), v) for v in (corners.x, corners.y, corners.z))
    with dr.suspend_grad():
        n = pi.compute_surface_interaction(mi.Ray3f(0, mi.Vector3f(0, 0, 1)), mi.RayFlags.Minimal).n
        return float(dr.sign(dr.dot(n, dr.cross(p1 - p0, p2 - p0)))[0])


def _analytic_patterns(plugin: str, families: list[StepFamily]) -> tuple:
    """Columns `parts` and `on_sides` of `ShapePatterns`."""
    nu, nv = ANALYTIC_GRID[plugin]
    u, v = (a.ravel() for a in np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"))
    corner = np.stack([u, v], 1)[:, None]
    halves = (np.array([[0, 0], [1, 0], [0, 1]]), np.array([[1, 1], [0, 1], [1, 0]]))
    uv = np.concatenate([corner + half for half in halves]) / np.array([nu, nv])
    patches = Patches(uv, uv, np.full(len(uv), int(SURFACES[plugin])))
    parts = []
    for lines in parallel_lines(families, uv.reshape(-1, 2), ENDS[plugin]):
        rows = rows_on(patches, None, lines, np.broadcast_to(lines.n, (len(uv), 2)))
        rows |= {f"v{i}": np.zeros(len(rows["part"])) for i in range(3)}
        parts.append((lines, rows))
    return parts, None


def pattern_kinds(
    job: Job, meshes: list[ShapeFacts], analytic: list[ShapeFacts], centre: mi.Point3f
) -> tuple[EdgeKind, ...]:
    """The patterns of all shapes as kinds of edges; none without any lines."""
    kinds = []
    for chosen, is_mesh in ((meshes, True), (analytic, False)):
        if not any(s.patterns for s in chosen):
            continue
        found = patterns_of(job, chosen)
        first, offsets = 0, []
        shapes = [job.scene.shapes()[s.index] for s in chosen]
        for shape in shapes:
            offsets.append(first)
            first += shape.vertex_count() if is_mesh else 0
        lines = _table(job.call.memory, is_mesh, found, offsets)
        if lines is None:
            continue
        moves = dr.gather(mi.Bool, uploaded(mi.Bool, np.array([s.moves for s in chosen])), lines.rows.shape)
        front, back = _seen_sides(job, chosen, found, lines)
        pointers = mi.ShapePtr(shapes) if len(shapes) > 1 else mi.ShapePtr(shapes[0])
        common = (lines, moves, front, back, pointers, centre)
        if is_mesh:
            positions = dr.detach(attached_positions(tuple(shapes)))
            dr.eval(positions)
            kinds.append(MeshPatterns(*common, tuple(shapes), positions))
        else:
            kinds.append(AnalyticPatterns(*common, tuple(shapes)))
    return tuple(kinds)


def _table(memory: Memory, is_mesh: bool, found: list[ShapePatterns | None], offsets: list[int]) -> PatternSet | None:
    """The lines of several shapes in one table, kept while they are the same; `offsets`: of their vertices."""
    known = memory[TABLES].get(is_mesh)
    if known is None or known[1] != offsets or [id(p) for p in known[0]] != [id(p) for p in found]:
        parts = []
        for k, patterns in enumerate(found):
            for lines, rows in patterns.parts if patterns is not None else ():
                corners = {v: rows[v] + offsets[k] for v in ("v0", "v1", "v2")}
                parts.append((lines, {**rows, **corners, "shape": np.full(len(rows["line"]), k)}))
        known = (found, offsets, pattern_set(parts))
        if known[2] is not None:
            dr.eval(known[2].rows, known[2].s, known[2].inset)
        memory[TABLES][is_mesh] = known
    return known[2]


def _seen_sides(
    job: Job, chosen: list[ShapeFacts], found: list[ShapePatterns | None], lines: PatternSet
) -> tuple[mi.Float, mi.Float]:
    """By row: can the front of the face, by its winding, be seen at all, and its back? 0 or 1.

    Not the inner side of a closed opaque shape that nobody is in, nor the back of a one-sided material.
    """
    lower, upper = origin_box(job.frame)
    sides, shells, firsts, first = [], [], [], 0
    for facts, patterns in zip(chosen, found, strict=True):
        shape = job.scene.shapes()[facts.index]
        outside = float(facts.opaque and apart(lower, upper, shape.bbox()))
        one_sided = not facts.bsdf_flags & int(mi.BSDFFlags.BackSide) and facts.is_mesh and not facts.smooth
        sides.append(patterns.side if one_sided and patterns is not None else 0.0)
        closed = _face_shells(shape, job.call.memory) if facts.is_mesh else mi.Float(facts.plugin == "sphere")
        shells.append(outside * closed)
        firsts.append(first)
        first += facts.faces if facts.is_mesh else 1
    shell = dr.concat(shells)
    rows = lines.rows
    part = rows.part if any(facts.is_mesh for facts in chosen) else mi.UInt32(0)
    closed = dr.gather(mi.Float, shell, dr.gather(mi.UInt32, uploaded(mi.UInt32, np.array(firsts)), rows.shape) + part)
    side = dr.gather(mi.Float, uploaded(mi.Float, np.array(sides)), rows.shape)
    front = dr.select((closed < 0) | (side < 0), mi.Float(0), 1)
    back = dr.select((closed > 0) | (side > 0), mi.Float(0), 1)
    dr.eval(front, back)
    return front, back


def _face_shells(mesh: mi.Mesh, memory: Memory) -> mi.Float:
    """By face: +1 on a closed surface with its normals outward, −1 inward, 0 elsewhere."""
    shells = dr.zeros(mi.Float, mesh.face_count())
    known = memory[TOPOLOGIES].get((mesh.id(), mesh.vertex_count(), mesh.face_count()))
    if known is not None:
        device = known.device
        dr.scatter(shells, known.shell * dr.select(device.opposed, 1.0, -1.0), device.f1)
        dr.scatter(shells, known.shell, device.f0)
    return shells
