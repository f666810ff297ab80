"""Smooth-shaded meshes × materials × motions × path lengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import mitsuba as mi
import numpy as np

from benchmarks import meshes
from benchmarks.check_lists.common import (
    ABOUT,
    LAMP,
    POINT,
    Listed,
    Motion,
    T,
    ground,
    lamp,
    moved,
    scene_of,
    sky,
    unit,
    view,
)

NAME = "smooth"

EYE, TARGET = (0.9, 1.4, 5.2), (0.1, -0.2, 0)
BESIDE = (1.3, 0.4, -0.7)  # a point of the axis that bodies turn about
STEP = 0.004  # of differences: a thirtieth of a pixel, which a blurred outline hardly shows
VERTEX_STEP = 0.008  # the same in edges of the mesh: .02 was off by half a per cent
SEEN_EDGES = 6.0  # width of the view of a vertex that moves
# Of rough materials: a step in heights of the vertex over its neighbours, at most in edges, seen from closer. Between
# the outlines of a face and of its shading they show their backs, metal none, on a strip a quarter as wide as that
# height: steps nearly as wide are off by 1 to 4 %, and smaller ones are lost in noise if seen from farther away.
ROUGH_BULGE_STEP, ROUGH_VERTEX_STEP, ROUGH_SEEN_EDGES = 0.025, 0.004, 1.5
#: Mitsuba draws visible normals of `beckmann`, its default, with a density that is up to .4 % off what it says. From as
#: close by as this, differences of `path` show that: 1 to 4 % of what is smooth, where it is seen at 60 degrees.
EXACTLY_SAMPLED = {"distribution": "ggx"}
SKY = {"sky": {"type": "constant", "radiance": 0.5}}  # lights that vertex, which turns away from lamps
BRIGHT_SIDE = (0.6, 0.7, -0.1)  # where the sky is brightest, of which rough materials show an image


def round_mesh(segments: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball about the origin, its poles a little tilted."""
    points, faces = meshes.ball(segments // 2, segments)
    return leant((points - meshes.CENTRE) / meshes.RADIUS), faces


def torus() -> tuple[np.ndarray, np.ndarray]:
    """48 segments along the ring, 24 around the tube."""
    n, m = 48, 24
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    φ, θ = 2 * np.pi * i / n, 2 * np.pi * j / m
    radius = 0.75 + 0.3 * np.cos(θ)
    points = np.stack([radius * np.cos(φ), radius * np.sin(φ), 0.3 * np.sin(θ)], -1)
    right, up = (i + 1) % n, (j + 1) % m
    a, b, c, d = (u * m + v for u, v in ((i, j), (right, j), (right, up), (i, up)))
    return leant(points), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def bumpy() -> tuple[np.ndarray, np.ndarray]:
    """A subdivided body with dents."""
    points, faces = meshes.ball(32, 64)
    ball = (points - meshes.CENTRE) / meshes.RADIUS
    φ = np.arctan2(ball[:, 2], ball[:, 0])
    dents = 1 + 0.18 * np.sin(3 * φ) * (1 - ball[:, 1] ** 2) + 0.1 * np.cos(5 * ball[:, 1])
    return leant(0.8 * dents[:, None] * ball), faces


def leant(points: np.ndarray) -> np.ndarray:
    turn = np.array(T().rotate(unit(0.3, 0.2, 1), 23).rotate(unit(1, 0.1, 0), 38).matrix)[:3, :3]
    return points @ turn.T


MESHES = {
    "ball of 16": partial(round_mesh, 16),
    "ball of 64": partial(round_mesh, 64),
    "ball of 200": partial(round_mesh, 200),
    "torus": torus,
    "bumpy body": bumpy,
}
#: Material, and the path lengths at which it does something else.
MATERIALS: dict[str, tuple[dict, tuple[int, ...]]] = {
    "light": ({"type": "area", "radiance": 2.0}, (1, 2)),
    "diffuse": ({"type": "diffuse"}, (2, 3)),
    "rough metal": ({"type": "roughconductor", "alpha": 0.3}, (2, 3)),
    "rough glass": ({"type": "roughdielectric", "alpha": 0.3}, (3,)),
}


def smooth_scene(
    mesh: str, plugin: dict, depth: int, camera: Callable[[], dict], lights: Callable[[], dict]
) -> mi.Scene:
    points, faces = MESHES[mesh]()
    shape = meshes.smooth_mesh("shape", points, faces, mi.load_dict(plugin))
    return scene_of(depth, camera(), shape=shape, floor=ground(-1.3), **lights())


def lamps_on(material: str) -> dict:
    return {} if material == "light" else {"lamp": lamp(*LAMP), "point": POINT}


def uneven_sky() -> dict:
    """Under an even one, a vertex of a rough metal changes next to nothing: differences are six times as noisy."""
    row, column = np.mgrid[0:64, 0:129]
    θ, φ = (row + 0.5) / 64 * np.pi, column / 128 * 2 * np.pi
    towards = np.stack([np.sin(φ) * np.sin(θ), np.cos(θ), -np.cos(φ) * np.sin(θ)], -1)
    radiance = 0.05 + 1.2 * np.exp(3 * (towards @ unit(*BRIGHT_SIDE) - 1))
    return {"sky": sky(np.repeat(radiance[..., None], 3, -1))}


@dataclass(frozen=True)
class Look:
    """What moves, and how it is looked at."""

    motion: Motion
    camera: Callable[[], dict]
    lights: Callable[[], dict]
    plugin: dict  # what the body is made of


def smooth() -> Iterator[Listed]:
    for mesh, make in MESHES.items():
        points, faces = make()
        for material, (plugin, depths) in MATERIALS.items():
            for how, look in looks(points, faces, material, plugin).items():
                for depth in depths:
                    scene = partial(smooth_scene, mesh, look.plugin, depth, look.camera, look.lights)
                    yield Listed(NAME, f"{mesh}, {material}, {how}, depth {depth}", scene, look.motion, 0.01, 0.004)


def looks(points: np.ndarray, faces: np.ndarray, material: str, plugin: dict) -> dict[str, Look]:
    """By motion. `plugin`: of the material."""
    whole = {
        "moved": moved("shape.vertex_positions", eps=STEP),
        "turned": swung(points),
        "camera": moved("camera.to_world", eps=STEP),
    }
    camera, lights = partial(view, EYE, TARGET), partial(lamps_on, material)
    found = {how: Look(motion, camera, lights, plugin) for how, motion in whole.items()}
    if material.startswith("rough"):
        return {**found, "vertex": Look(*one_rough_vertex(points, faces), uneven_sky, plugin | EXACTLY_SAMPLED)}
    return {**found, "vertex": Look(*one_vertex(points, faces), lambda: SKY, plugin)}


def swung(points: np.ndarray) -> Motion:
    """Velocities of a turn about an axis beside the body: about one through its middle, a ball stays what it is."""
    return Motion("shape.vertex_positions", STEP, np.cross(ABOUT, points - BESIDE))


def one_vertex(points: np.ndarray, faces: np.ndarray) -> tuple[Motion, Callable[[], dict]]:
    """The vertex that is farthest to the upper right in the view, outwards: on the outline. Seen from close by.

    The finer the mesh, the more a step turns the normals around it.
    """
    k, edge = outermost(points), edge_length(points, faces)
    return outwards(points, k, VERTEX_STEP * edge), close_view(points[k], SEEN_EDGES * edge)


def one_rough_vertex(points: np.ndarray, faces: np.ndarray) -> tuple[Motion, Callable[[], dict]]:
    """The same vertex, as rough materials need it."""
    k, edge = outermost(points), edge_length(points, faces)
    neighbours = np.setdiff1d(faces[(faces == k).any(1)], k)
    bulge = np.linalg.norm(points[k] - points[neighbours].mean(0))
    step = min(ROUGH_BULGE_STEP * bulge, ROUGH_VERTEX_STEP * edge)
    return outwards(points, k, step), close_view(points[k], ROUGH_SEEN_EDGES * edge)


def outermost(points: np.ndarray) -> int:
    forward = np.subtract(TARGET, EYE) / np.linalg.norm(np.subtract(TARGET, EYE))
    across = np.cross(forward, [-0.6, 0.8, 0])  # to the right and up
    seen = points - EYE
    return int(np.argmax((seen @ across) / (seen @ forward)))


def edge_length(points: np.ndarray, faces: np.ndarray) -> float:
    return float(np.linalg.norm(points[faces[:, 0]] - points[faces[:, 1]], axis=1).mean())


def outwards(points: np.ndarray, k: int, step: float) -> Motion:
    """Of vertex k alone."""
    direction = np.zeros_like(points)
    direction[k] = points[k] / np.linalg.norm(points[k])
    return Motion("shape.vertex_positions", step, direction)


def close_view(point: np.ndarray, width: float) -> Callable[[], dict]:
    fov = np.degrees(width / np.linalg.norm(point - EYE))
    return partial(view, EYE, tuple(point.tolist()), float(fov))
