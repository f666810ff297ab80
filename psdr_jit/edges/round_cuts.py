"""Curves in which a sphere or a cylinder cuts the faces of a mesh. On the host, in double precision.

In the plane of a face the curve is the image of a circle, x(θ) = m + U cos θ + V sin θ. A line of the plane crosses it
where A cos θ + B sin θ = C, and so does a plane that ends a cylinder: all bounds of an arc are found in one way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .intersections import TriangleMesh, in_box, tolerance

#: |cos| of the angle between a cylinder's axis and the normal of a face, below which they meet in straight lines.
ALONG = 1e-5


@dataclass(frozen=True)
class Arcs:
    """Pieces of the curves in which a round body cuts faces: chords (N rows) to be bent onto the body."""

    face: np.ndarray  # (N,)
    start: np.ndarray  # (N, 3)
    end: np.ndarray
    centre: np.ndarray  # (N, 3) of the curve
    radius: np.ndarray  # (N,) of it, seen along the axis; 0: a straight piece
    axis: np.ndarray  # (N, 3) unit, of a cylinder; 0 of a sphere


@dataclass(frozen=True)
class Tube:
    """A cylinder without caps."""

    base: np.ndarray  # (3,)
    axis: np.ndarray  # unit
    height: float
    radius: float

    def box(self) -> np.ndarray:
        reach = self.radius * np.sqrt(np.maximum(1 - self.axis**2, 0))
        ends = np.stack([self.base, self.base + self.height * self.axis])
        return np.stack([ends.min(0) - reach, ends.max(0) + reach])


@dataclass(frozen=True)
class _Bounds:
    """Half-spaces g·x ≥ c, as rows."""

    g: np.ndarray  # (K, 3)
    c: np.ndarray  # (K,)

    @staticmethod
    def of_triangle(corners: np.ndarray, n: np.ndarray) -> _Bounds:
        g = np.cross(n, np.roll(corners, -1, 0) - corners)
        return _Bounds(g, np.einsum("ij,ij->i", g, corners))

    def and_ends(self, tube: Tube) -> _Bounds:
        low = tube.axis @ tube.base
        return _Bounds(np.vstack([self.g, tube.axis, -tube.axis]), np.append(self.c, [low, -low - tube.height]))

    def arcs(self, m: np.ndarray, U: np.ndarray, V: np.ndarray, pieces: int) -> Iterator[tuple]:
        """Chords `(start, end)` of the parts of x(θ) within."""
        A, B, C = self.g @ U, self.g @ V, self.c - self.g @ m
        size = np.hypot(A, B)
        crossed = np.abs(C) < size
        towards, half = np.arctan2(B, A)[crossed], np.arccos(C[crossed] / size[crossed])
        cuts = np.unique([0, 2 * np.pi, *((towards - half) % (2 * np.pi)), *((towards + half) % (2 * np.pi))])
        for begin, stop in zip(cuts[:-1], cuts[1:], strict=True):
            at = 0.5 * (begin + stop)
            if np.any(A * np.cos(at) + B * np.sin(at) < C):
                continue
            angles = np.linspace(begin, stop, 2 + int(pieces * (stop - begin) / (2 * np.pi)))
            points = m + np.cos(angles)[:, None] * U + np.sin(angles)[:, None] * V
            yield from zip(points[:-1], points[1:], strict=True)

    def lines(self, x: np.ndarray, d: np.ndarray) -> Iterator[tuple]:
        """The part of the line x + s d within, as `(start, end)`, if there is any."""
        slope, need = self.g @ d, self.c - self.g @ x
        if np.any((slope == 0) & (need > 0)):
            return
        s = need[slope != 0] / slope[slope != 0]
        low, high = s[slope[slope != 0] > 0].max(initial=-np.inf), s[slope[slope != 0] < 0].min(initial=np.inf)
        if low < high:
            yield x + low * d, x + high * d


def ball_mesh(centre: np.ndarray, radius: float, b: TriangleMesh, pieces: int) -> Arcs:
    """Arcs in which the sphere cuts faces of `b`; the ends of the arcs lie on the faces' edges, up to rounding."""
    box = np.stack([centre - radius, centre + radius])
    tol = tolerance(box, b.box)
    out = []
    for f in _at_sphere(centre, radius, b, in_box(b.positions, b.faces, box), tol):
        corners = b.positions[b.faces[f]].astype(float)
        n = _normal(corners)
        height = n @ (centre - corners[0])
        if abs(height) >= radius - tol:
            continue
        middle, size = centre - height * n, np.sqrt(radius**2 - height**2)
        u, v = _across(n)
        for start, end in _Bounds.of_triangle(corners, n).arcs(middle, size * u, size * v, pieces):
            out.append((f, start, end, middle, size, np.zeros(3)))
    return _joined(out)


def cylinder_mesh(tube: Tube, b: TriangleMesh, pieces: int) -> Arcs:
    """Arcs of ellipses, and lines, in which the cylinder cuts faces of `b`."""
    box = tube.box()
    tol = tolerance(box, b.box)
    u, v = (tube.radius * side for side in _across(tube.axis))
    out = []
    for f in _at_cylinder(tube, b, in_box(b.positions, b.faces, box), tol):
        corners = b.positions[b.faces[f]].astype(float)
        n = _normal(corners)
        slope, height = n @ tube.axis, n @ (corners[0] - tube.base)
        within = _Bounds.of_triangle(corners, n).and_ends(tube)
        if abs(slope) > ALONG:
            m = tube.base + height / slope * tube.axis
            U, V = (side - (n @ side) / slope * tube.axis for side in (u, v))
            out += [(f, *ends, m, tube.radius, tube.axis) for ends in within.arcs(m, U, V, pieces)]
        elif abs(height) < tube.radius - tol:
            aside = np.cross(n, tube.axis) * np.sqrt(tube.radius**2 - height**2)
            for x in (tube.base + height * n + aside, tube.base + height * n - aside):
                out += [(f, *ends, np.zeros(3), 0.0, tube.axis) for ends in within.lines(x, tube.axis)]
    return _joined(out)


def _joined(rows: list[tuple]) -> Arcs:
    if not rows:
        none = np.zeros((0, 3))
        return Arcs(np.zeros(0, int), none, none, none, np.zeros(0), none)
    return Arcs(*(np.array(column) for column in zip(*rows, strict=True)))


def _normal(corners: np.ndarray) -> np.ndarray:
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    return n / max(np.linalg.norm(n), 1e-300)


def _across(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    return u, np.cross(n, u)


def _at_sphere(centre: np.ndarray, radius: float, b: TriangleMesh, faces: np.ndarray, tol: float) -> np.ndarray:
    """Those of the `faces` that the sphere may cut: neither all inside of it, nor farther from it than they are large.

    Of a fine mesh inside of a large ball, or beside one, these are few, and what follows looks at them one by one.
    """
    corners = b.positions[b.faces[faces]].astype(float)
    distance, farthest, middle = _distances(corners - centre)
    return faces[(distance.max(1) >= radius - tol) & (middle - farthest <= radius + tol)]


def _at_cylinder(tube: Tube, b: TriangleMesh, faces: np.ndarray, tol: float) -> np.ndarray:
    """The same for a cylinder, by distances from its axis."""
    offset = b.positions[b.faces[faces]].astype(float) - tube.base
    distance, farthest, middle = _distances(offset - (offset @ tube.axis)[..., None] * tube.axis)
    return faces[(distance.max(1) >= tube.radius - tol) & (middle - farthest <= tube.radius + tol)]


def _distances(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of corners (N, 3, 3) from the origin, of the farthest from their middle, and of that from the origin."""
    middle = corners.mean(1)
    farthest = np.linalg.norm(corners - middle[:, None], axis=2).max(1)
    return np.linalg.norm(corners, axis=2), farthest, np.linalg.norm(middle, axis=1)
