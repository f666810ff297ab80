"""Where analytic shapes are: their object-to-world maps as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import joined


def on_host(to_world) -> np.ndarray:
    """The matrix (4, 4) of a transform, detached, in double precision."""
    return np.array(dr.detach(to_world.matrix), dtype=float).reshape(4, 4)


@dataclass(frozen=True)
class Poses:
    """Object-to-world maps (x, y, z axis, origin) of several shapes or lights, read once."""

    matrices: tuple[mi.Matrix4f, ...]  # attached to the shapes' `to_world`
    columns: tuple[mi.Vector3f, ...]  # one entry for each shape; detached

    @staticmethod
    def of(shapes: Sequence[mi.Object]) -> Poses:
        matrices = tuple(mi.traverse(shape)["to_world"].matrix for shape in shapes)
        columns = tuple(mi.Vector3f(*(joined([dr.detach(mi.Float(m[i, j])) for m in matrices]) for i in range(3)))
                        for j in range(4))  # fmt: skip
        dr.eval(columns)
        return Poses(matrices, columns)

    def at(self, index: mi.UInt32) -> tuple[mi.Vector3f, ...]:
        """Of each lane's shape, detached."""
        return tuple(dr.gather(mi.Vector3f, column, index) for column in self.columns)

    def attached_at(self, index: mi.UInt32) -> tuple[mi.Vector3f, ...]:
        """Of each lane's shape, attached."""
        moving = [k for k, matrix in enumerate(self.matrices) if dr.grad_enabled(matrix)]
        if not moving:
            return self.at(index)

        def entry(i: int, j: int) -> mi.Float:
            values = mi.Float(self.columns[j][i])
            for k in moving:
                dr.scatter(values, mi.Float(self.matrices[k][i, j]), mi.UInt32(k))
            return dr.gather(mi.Float, values, index)

        return tuple(mi.Vector3f(*(entry(i, j) for i in range(3))) for j in range(4))


def spheres_of(scene: mi.Scene, indices: Sequence[int]) -> tuple[mi.Point3f, mi.Float]:
    """`(centres, radii)` in world space of the `sphere` shapes with these places in the scene, as they are now.

    Stored, one entry for each, detached. Scales are uniform: Mitsuba's spheres have no others.
    """
    shapes = scene.shapes()
    x_axis, _, _, centre = Poses.of([shapes[index] for index in indices]).columns
    centres, radii = mi.Point3f(centre), dr.norm(x_axis)
    dr.make_opaque(centres, radii)
    return centres, radii
