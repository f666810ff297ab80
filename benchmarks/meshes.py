"""Meshes for sweeps: balls of any fineness or of slivers, boxes with subdivided faces. Welded, closed."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

RADIUS, CENTRE = 0.4, (0.0, -0.3, 0.0)  # [scene units] where the blocker of area_shadow.xml is
TURN = np.deg2rad(30)  # about y: no face looks along an axis


def round_ball(triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """A sphere of about so many triangles."""
    rings = max(2, round(np.sqrt(triangles / 4)))
    return ball(rings, 2 * rings)


def ball(rings: int, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a sphere from rings; few rings of many segments are slivers."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    θ, φ = np.meshgrid(np.linspace(0, np.pi, rings + 1)[1:-1], turn, indexing="ij")
    ring_points = np.stack([np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)], -1).reshape(-1, 3)
    points = np.concatenate([[[0, 1, 0]], ring_points, [[0, -1, 0]]])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings - 2), np.arange(segments), indexing="ij"))
    k = (j + 1) % segments
    a, b, c, d = (1 + i * segments + j, 1 + i * segments + k, 1 + (i + 1) * segments + j, 1 + (i + 1) * segments + k)
    j, k = np.arange(segments), (np.arange(segments) + 1) % segments
    last = len(points) - 1
    caps = [np.stack([0 * j, 1 + k, 1 + j], 1), np.stack([0 * j + last, last - segments + j, last - segments + k], 1)]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1), *caps])
    return RADIUS * points + CENTRE, faces


def box(cells: int, bulge: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A cube whose faces are grids of `cells` × `cells` squares, two triangles each.

    `bulge`: inner vertices of the faces are moved outwards by up to this many edge lengths of the cube, at random, so
    that neighbours are nearly, but not quite, in one plane.
    """
    ticks, n = np.linspace(-1, 1, cells + 1), cells + 1
    u, v = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    grid = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rng = np.random.default_rng(1)
    inside = (np.abs(u) < 1) & (np.abs(v) < 1)
    points, faces = [], []
    for axis in range(3):
        for sign in (1, -1):
            height = sign * (1 + 2 * bulge * inside * rng.random(len(u)))
            face = np.zeros((len(u), 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = height, u, v
            faces.append((grid if sign > 0 else grid[:, ::-1]) + len(u) * len(points))
            points.append(face)
    stacked, index = np.concatenate(points), np.concatenate(faces)
    _, first, inverse = np.unique(np.round(stacked, 9), axis=0, return_index=True, return_inverse=True)
    turned = stacked[first] @ np.array([[np.cos(TURN), 0, -np.sin(TURN)], [0, 1, 0], [np.sin(TURN), 0, np.cos(TURN)]])
    return RADIUS * turned + CENTRE, inverse.ravel()[index]


def replaced(scene: Any, name: str, points: np.ndarray, faces: np.ndarray) -> Any:
    """The scene with the mesh `name` replaced by another shape of the same material, shaded as smoothly."""
    parts: dict[str, Any] = {"type": "scene", "sensor": scene.sensors()[0]}
    for shape in scene.shapes():
        make = smooth_mesh if shape.has_vertex_normals() else flat_mesh
        parts[shape.id()] = make(name, points, faces, shape.bsdf()) if shape.id() == name else shape
    for k, emitter in enumerate(e for e in scene.emitters() if not mi.has_flag(e.flags(), mi.EmitterFlags.Surface)):
        parts[emitter.id() or f"emitter-{k}"] = emitter
    return mi.load_dict(parts, optimize=False)


def flat_mesh(name: str, points: np.ndarray, faces: np.ndarray, bsdf: Any) -> Any:
    """A flat-shaded Mitsuba mesh."""
    return _filled(mi.Mesh(name, len(points), len(faces), props=_props(bsdf, True)), points, faces)


def smooth_mesh(name: str, points: np.ndarray, faces: np.ndarray, bsdf: Any) -> Any:
    """A smooth-shaded Mitsuba mesh. `bsdf`: or the emitter that it carries."""
    mesh = mi.Mesh(name, len(points), len(faces), has_vertex_normals=True, props=_props(bsdf, False))
    return _filled(mesh, points, faces)


def _props(bsdf: Any, face_normals: bool) -> Any:
    props = mi.Properties()
    props["bsdf"], props["face_normals"] = bsdf, face_normals
    return props


def _filled(mesh: Any, points: np.ndarray, faces: np.ndarray) -> Any:
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return mesh
