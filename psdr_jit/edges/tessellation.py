"""Shapes as triangles, to ask whether two of them cut into each other at all. On the host, detached."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import CONTROL_POINTS, mesh_faces, mesh_positions
from ..core.ellipsoid import Ellipsoid
from ..core.tube_axis import Axis
from ..scene.capabilities import CURVE_SHAPES, ELLIPSOID_SHAPES, GRID_SHAPES
from ..scene.poses import on_host
from .grid_triangles import grid_triangles
from .intersections import cross, tolerance

#: Corners of a tessellated circle; rings of a sphere are half as many.
CORNERS = 96

#: Corners of a circle of a tube, and circles of one segment.
TUBE_CORNERS, TUBE_RINGS = 24, 6

#: By how much the corners of a polygon are moved outwards, so that it lies around its circle.
AROUND = 1 / np.cos(np.pi / CORNERS)


def cut_each_other(a: tuple[mi.Shape, str], b: tuple[mi.Shape, str]) -> bool:
    """Do the surfaces of two `(shape, plugin)` cross? Curved ones are taken as polyhedra in and around them."""
    for outward in {1.0, AROUND}:
        triangles = [_triangles(shape, plugin, outward) for shape, plugin in (a, b)]
        boxes = [np.stack([t.min((0, 1)), t.max((0, 1))]) for t in triangles]
        if cross(*triangles, tolerance(*boxes)):
            return True
    return False


def _triangles(shape: mi.Shape, plugin: str, outward: float) -> np.ndarray:
    """(F, 3, 3) in world space; radii of circles grow by the factor `outward`."""
    if shape.is_mesh():
        return np.array(dr.detach(mesh_positions(shape)), float).T[np.array(mesh_faces(shape)).T]
    if plugin in GRID_SHAPES:
        return grid_triangles(shape.shape, shape.to_world())
    if plugin in ELLIPSOID_SHAPES:
        return _quads(_ellipsoids(shape, outward))
    if plugin in CURVE_SHAPES:
        return _quads(_tube(shape, outward) if plugin == "bsplinecurve" else _rods(shape, outward))
    to_world = on_host(mi.traverse(shape)["to_world"])
    turn = 2 * np.pi * np.arange(CORNERS + 1) / CORNERS
    circle = outward * np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    if plugin == "disk":
        rings = [0 * circle, circle]
    elif plugin == "cylinder":
        rings = [circle, circle + [0, 0, 1]]
    else:
        polar = np.linspace(0, np.pi, CORNERS // 2 + 1)
        rings = [np.sin(θ) * circle + [0, 0, outward * np.cos(θ)] for θ in polar]
    rings = np.stack(rings) @ to_world[:3, :3].T + to_world[:3, 3]
    return _quads(rings)


def _tube(shape: mi.Shape, outward: float) -> np.ndarray:
    """Circles about the axis of every segment of a curve: (rings, segments, corners + 1, 3)."""
    params = mi.traverse(shape)
    flat, first = dr.detach(params[CONTROL_POINTS]), mi.UInt32(params["segment_indices"])
    points = [dr.gather(mi.Vector4f, flat, first + k) for k in range(4)]
    rings = []
    for v in np.linspace(0, 1, TUBE_RINGS + 1):
        axis = Axis.of(points, mi.Float(v))
        a, b, _ = axis.circle(mi.coordinate_system(dr.normalize(axis.dc))[0])
        c, a, b, r = (np.array(value, float).T[..., None] for value in (axis.c, a, b, axis.r))
        turn = 2 * np.pi * np.arange(TUBE_CORNERS + 1) / TUBE_CORNERS
        ring = c + outward * r[:, None] * (a * np.cos(turn) + b * np.sin(turn))  # segments, 3, corners
        rings.append(ring.swapaxes(1, 2))
    return np.stack(rings)


def _ellipsoids(shape: mi.Shape, outward: float) -> np.ndarray:
    """Circles of latitude of all ellipsoids of a shape: (rings, ellipsoids, corners + 1, 3)."""
    params = mi.traverse(shape)
    data = dr.detach(params["data"])
    first = dr.arange(mi.UInt32, dr.width(data) // 10) * 10
    bodies = Ellipsoid.of([dr.gather(mi.Float, data, first + k) for k in range(10)], mi.Float(params["extent"]))
    c = np.array(bodies.c, float).T
    axes = [np.array(bodies.vector(mi.Vector3f(*m)) + 0 * bodies.c, float).T for m in np.eye(3)]
    turn = 2 * np.pi * np.arange(TUBE_CORNERS + 1) / TUBE_CORNERS
    rings = []
    for polar in np.linspace(0, np.pi, TUBE_CORNERS // 2 + 1):
        m = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0 * turn])
        rings.append(c[:, None] + outward * sum(axes[k][:, None] * m[k][:, None] for k in range(3)))
    return np.stack(rings)


def _rods(shape: mi.Shape, outward: float) -> np.ndarray:
    """Circles about every segment of a linear curve: (rings, segments, corners + 1, 3)."""
    params = mi.traverse(shape)
    points = np.array(dr.detach(params[CONTROL_POINTS]), float).reshape(-1, 4)
    first = np.array(params["segment_indices"]).astype(np.int64)
    a, b = points[first], points[first + 1]
    u = (b - a)[:, :3]
    length = np.linalg.norm(u, axis=1, keepdims=True)
    u, slope = u / length, (b - a)[:, 3:] / length
    side = np.cross(u, np.eye(3)[np.abs(u).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(u, side)
    turn = 2 * np.pi * np.arange(TUBE_CORNERS + 1) / TUBE_CORNERS
    circle = side[..., None] * np.cos(turn) + up[..., None] * np.sin(turn)  # segments, 3, corners
    tangent = np.arccos(np.clip(-slope, -1, 1))  # angle between the axis and the normal where the cone begins
    shares, rings = np.linspace(0, 1, TUBE_RINGS + 1), []
    for end, angles in ((a, np.pi + (tangent - np.pi) * shares), (b, tangent * (1 - shares))):
        for angle in angles.T:
            n = np.cos(angle)[:, None, None] * u[..., None] + np.sin(angle)[:, None, None] * circle
            rings.append((end[:, :3, None] + outward * end[:, 3, None, None] * n).swapaxes(1, 2))
    return np.stack(rings)


def _quads(rings: np.ndarray) -> np.ndarray:
    """(F, 3, 3) between neighbours of rings (R, ..., corners, 3)."""
    a, b, c, d = rings[:-1, ..., :-1, :], rings[:-1, ..., 1:, :], rings[1:, ..., 1:, :], rings[1:, ..., :-1, :]
    return np.concatenate([np.stack([a, b, c], -2).reshape(-1, 3, 3), np.stack([a, c, d], -2).reshape(-1, 3, 3)])
