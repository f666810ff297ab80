"""One cell of a grid of signed distances: the surface f = 0 of what is interpolated between its eight corners.

f is linear in each coordinate of p = (X, Y, Z) ∈ [0, 1]³. Seen from the homogeneous viewpoint (e, w), in coordinates
of the cell, its outline is where f = 0 and g = ∇f·(e − w p) = 0. At a fixed Z both are bilinear in X and Y,

    f = a₀ + a₁X + a₂Y + a₃XY,     g = b₀ + b₁X + b₂Y + b₃XY,

so that Y = −(a₀ + a₁X) / (a₂ + a₃X), and X solves a quadratic equation. The direction of the outline is ∇f × ∇g with
∇g = H (e − w p) − w ∇f, of which the last part does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Cell:
    """Values at the corners; attached if they are. One entry per sample."""

    low: list[mi.Float]  # at Z = 0, for (X, Y) = (0, 0), (1, 0), (0, 1), (1, 1)
    high: list[mi.Float]  # at Z = 1

    def value(self, p: mi.Vector3f) -> mi.Float:
        return dr.lerp(_on_face(self.low, p.x, p.y), _on_face(self.high, p.x, p.y), p.z)

    def gradient(self, p: mi.Vector3f) -> mi.Vector3f:
        a, d = _coefficients(self._layer(p.z)), _coefficients(self._slopes())
        return mi.Vector3f(a[1] + a[3] * p.y, a[2] + a[3] * p.x, d[0] + d[1] * p.x + d[2] * p.y + d[3] * p.x * p.y)

    def bend(self, p: mi.Vector3f, q: mi.Vector3f) -> mi.Vector3f:
        """H q, of the second derivatives H at p."""
        a, d = _coefficients(self._layer(p.z)), _coefficients(self._slopes())
        xy, xz, yz = a[3], d[1] + d[3] * p.y, d[2] + d[3] * p.x
        return mi.Vector3f(xy * q.y + xz * q.z, xy * q.x + yz * q.z, xz * q.x + yz * q.y)

    def outline(self, z: mi.Float, view: mi.Vector4f, root: mi.Float) -> tuple[mi.Vector3f, mi.Bool]:
        """`(p, whether it exists)`: the outline at Z = `z`, of its two points that with `root` = ±1."""
        a, d = _coefficients(self._layer(z)), _coefficients(self._slopes())
        e, w = mi.Vector3f(view.x, view.y, view.z), view.w
        h = e.z - w * z
        b = [
            a[1] * e.x + a[2] * e.y + h * d[0],
            a[3] * e.y - w * a[1] + h * d[1],
            a[3] * e.x - w * a[2] + h * d[2],
            h * d[3] - 2 * w * a[3],
        ]
        q0, q2 = b[0] * a[2] - b[2] * a[0], b[1] * a[3] - b[3] * a[1]
        q1 = b[0] * a[3] + b[1] * a[2] - b[2] * a[1] - b[3] * a[0]
        room = dr.square(q1) - 4 * q0 * q2
        far = q1 + root * dr.safe_sqrt(room)
        near = q1 - root * dr.safe_sqrt(room)
        by_far = root * q1 >= 0  # the root whose sum does not cancel, in either of its two forms
        x = dr.select(by_far, -2 * q0 / far, -near / (2 * q2))
        by_f, by_g = a[2] + a[3] * x, b[2] + b[3] * x
        use_f = dr.abs(by_f) * dr.norm(e - w * 0.5) >= dr.abs(by_g)
        y = dr.select(use_f, -(a[0] + a[1] * x) / by_f, -(b[0] + b[1] * x) / by_g)
        inside = (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
        return mi.Vector3f(dr.select(inside, x, 0.5), dr.select(inside, y, 0.5), z), inside & (room > 0)

    def along_outline(self, p: mi.Vector3f, view: mi.Vector4f) -> mi.Vector3f:
        """Tangent of the outline at its point p; of any length."""
        q = mi.Vector3f(view.x, view.y, view.z) - view.w * p
        return dr.cross(self.gradient(p), self.bend(p, q))

    def _layer(self, z: mi.Float) -> list[mi.Float]:
        return [dr.lerp(a, b, z) for a, b in zip(self.low, self.high, strict=True)]

    def _slopes(self) -> list[mi.Float]:
        return [b - a for a, b in zip(self.low, self.high, strict=True)]


def across_face(face: list[mi.Float], x: mi.Float) -> tuple[mi.Float, mi.Float]:
    """`(Y, dY/dX)` of the curve on which the four values of a face are interpolated to 0."""
    a = _coefficients(face)
    by = a[2] + a[3] * x
    y = -(a[0] + a[1] * x) / by
    return y, -(a[1] + a[3] * y) / by


def _coefficients(f: list[mi.Float]) -> list[mi.Float]:
    return [f[0], f[1] - f[0], f[2] - f[0], f[3] - f[2] - f[1] + f[0]]


def _on_face(f: list[mi.Float], x: mi.Float, y: mi.Float) -> mi.Float:
    return dr.lerp(dr.lerp(f[0], f[1], x), dr.lerp(f[2], f[3], x), y)
