"""The patterns of one shape: its patches, and the rows of lines on them, but for what depends on other shapes."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_faces, mesh_positions, texcoords_buffer
from ..core.upload import uploaded
from ..scene.patterns import StepFamily
from .pattern_rows import End, Lines, Patches, parallel_lines, rows_on, sides_on_lines
from .surface_points import Surface

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

#: Corners of a face in its own coordinates, which are those of a texture on a mesh without any.
BARYCENTRIC = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

#: Ratio of the widths of a face in texture coordinates below which it has no area there.
FLAT = 1e-6


@dataclass(frozen=True)
class ShapePatterns:
    """See the module."""

    parts: list[tuple[Lines, dict[str, np.ndarray]]]
    on_sides: mi.Bool | None  # of a mesh, by 3 · face + corner: is there a step along the side opposite to it?
    front: float  # +1: seen from in front, faces are wound counterclockwise; −1: clockwise; 0: unknown


def texture_reach(shape: mi.Shape) -> np.ndarray:
    """Texture coordinates (N, 2) among which all of a shape lie."""
    return texcoords(shape).reshape(-1, 2) if shape.is_mesh() else np.array([[0.0, 0.0], [1.0, 1.0]])


def texcoords(mesh: mi.Mesh) -> np.ndarray:
    """Texture coordinates (F, 3, 2) of the corners of all faces; on a mesh without any, their barycentric ones."""
    faces = np.array(mesh_faces(mesh)).T
    if not mesh.has_vertex_texcoords():
        return np.tile(BARYCENTRIC, (len(faces), 1, 1))
    return np.nan_to_num(np.array(dr.detach(texcoords_buffer(mesh)), float), posinf=0, neginf=0).reshape(-1, 2)[faces]


def mesh_patterns(mesh: mi.Mesh, families: list[StepFamily], everywhere: bool) -> ShapePatterns:
    """Lines on the faces of a mesh; `everywhere`: all of its edges may be steps as well."""
    faces, uv = np.array(mesh_faces(mesh)).T, texcoords(mesh)
    everywhere |= len(families) > 0 and not mesh.has_vertex_texcoords()
    found = parallel_lines(families, uv.reshape(-1, 2))
    patches = face_patches(uv, int(np.ceil(np.sqrt(LEAST_PATCHES / max(len(uv), 1)))))
    # q = (uv − uv_0) J⁻¹; the pseudo-inverse where a face has no area in texture coordinates
    inverse = np.linalg.pinv(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], 1), rcond=FLAT)
    parts = []
    for lines in found:
        rows = rows_on(patches, uv, lines, (lines.n @ inverse)[patches.part])
        rows |= {f"v{i}": faces[rows["part"], i] for i in range(3)}
        parts.append((lines, rows))
    on_sides = np.full((len(faces), 3), True) if everywhere else sides_on_lines(uv, found)
    return ShapePatterns(parts, uploaded(mi.Bool, on_sides) if on_sides.any() else None, winding(mesh))


def analytic_patterns(plugin: str, families: list[StepFamily]) -> ShapePatterns:
    """Lines on a shape without triangles."""
    patches, parts = body_patches(plugin, ANALYTIC_GRID[plugin]), []
    uv = patches.uv
    for lines in parallel_lines(families, uv.reshape(-1, 2), ENDS[plugin]):
        rows = rows_on(patches, None, lines, np.broadcast_to(lines.n, (len(uv), 2)))
        rows |= {f"v{i}": np.zeros(len(rows["part"])) for i in range(3)}
        parts.append((lines, rows))
    return ShapePatterns(parts, None, 0.0)


def body_patches(plugin: str, grid: tuple[int, int]) -> Patches:
    """A shape without triangles, in two patches for each cell of a `grid` along both texture coordinates."""
    nu, nv = grid
    u, v = (a.ravel() for a in np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"))
    corner = np.stack([u, v], 1)[:, None]
    halves = (np.array([[0, 0], [1, 0], [0, 1]]), np.array([[1, 1], [0, 1], [1, 0]]))
    uv = np.concatenate([corner + half for half in halves]) / np.array([nu, nv])
    return Patches(uv, uv, np.full(len(uv), int(SURFACES[plugin])))


def face_patches(uv: np.ndarray, n: int) -> Patches:
    """Faces with texture coordinates (F, 3, 2), each cut into n² triangles."""
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
    at, b = uv[part][:, None], q[..., None]
    origin, sides = at[:, :, 0], (at[:, :, 1] - at[:, :, 0], at[:, :, 2] - at[:, :, 0])
    return Patches(origin + b[:, :, 0] * sides[0] + b[:, :, 1] * sides[1], q, part)


def winding(mesh: mi.Mesh) -> float:
    """`ShapePatterns.front`, by the normal that Mitsuba gives the first face."""
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.t, pi.prim_uv, pi.valid = mi.Float(0), mi.Point2f(1 / 3), mi.Bool(True)
    pi.shape = mi.ShapePtr(mesh)
    corners = dr.gather(mi.Vector3u, mesh_faces(mesh), 0)
    p0, p1, p2 = (dr.gather(mi.Point3f, dr.detach(mesh_positions(mesh)), v) for v in (corners.x, corners.y, corners.z))
    with dr.suspend_grad():
        n = pi.compute_surface_interaction(mi.Ray3f(0, mi.Vector3f(0, 0, 1)), mi.RayFlags.Minimal).n
        return float(dr.sign(dr.dot(n, dr.cross(p1 - p0, p2 - p0)))[0])
