"""The spheres of a scene beside its meshes as a table of poses: see `mesh_tables`."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ad import accumulate, tangents
from ..core.memory import Memory, Slot, while_unchanged
from ..core.upload import uploaded
from ..core.varying import varying
from .grids import TO_WORLD
from .names import plugin_name
from .registry import registry_values

#: Numbers of a pose: three rows of its matrix.
ROWS, COLUMNS = 3, 4

#: Of an integrator: poses as they were read last.
POSES: Slot[dict] = Slot(dict)


@dataclass(frozen=True)
class SphereTable:
    """Spheres, detached but for `poses`; host object."""

    place: mi.UInt32  # by registry index of a shape: 1 + which of them it is, 0: none of them
    outward: mi.Float  # −1 where normals are flipped, else 1
    poses: mi.Float  # rows of their matrices; a variable of its own where one of them moves
    moving: tuple[tuple[int, tuple[mi.Float, ...]], ...]  # which of them, and Mitsuba's numbers

    def take_tangents(self) -> None:
        """Give the variable the tangents of Mitsuba's numbers."""
        with dr.resume_grad():
            grad = dr.zeros(mi.Float, dr.width(self.poses))
            for which, numbers in self.moving:
                for k, tangent in enumerate(tangents(*numbers)):
                    dr.scatter(grad, tangent, varying(mi.UInt32, len(numbers) * which + k))
            dr.set_grad(self.poses, grad)

    def hand_on(self) -> None:
        """Add the gradients of the variable to those of Mitsuba's numbers."""
        with dr.resume_grad():
            grad = dr.grad(self.poses)
            for which, numbers in self.moving:
                first = varying(mi.UInt32, len(numbers) * which)
                accumulate(sum(x * dr.gather(mi.Float, grad, first + k) for k, x in enumerate(numbers)))


def is_sphere(shape: mi.Shape) -> bool:
    return plugin_name(shape) == "sphere"


def sphere_table(scene: mi.Scene, ids: list[int], memory: Memory, most: int) -> SphereTable | None:
    """The spheres of `scene`, whose shapes have these registry indices; None if there are none. `most`: how many tables
    are kept.
    """
    shapes = scene.shapes()
    chosen = [k for k, shape in enumerate(shapes) if is_sphere(shape)]
    if not chosen:
        return None
    with dr.resume_grad():
        read = [_numbers(shapes[k]) for k in chosen]
        moving = tuple((which, own) for which, own in enumerate(read) if dr.grad_enabled(own))
    flipped = [shapes[k].has_flipped_normals() for k in chosen]
    every = [x for own in read for x in own]

    def made() -> tuple[mi.UInt32, mi.Float, mi.Float]:
        place = registry_values(scene, {k: which + 1 for which, k in enumerate(chosen)})
        values = np.concatenate([np.array(dr.detach(x)).ravel() for x in every])
        return place, uploaded(mi.Float, np.where(flipped, -1.0, 1.0)), uploaded(mi.Float, values)

    place, outward, known = while_unchanged(memory[POSES], (*ids, *chosen, *flipped), every, made, most)
    poses = mi.Float(known)
    if moving:
        dr.enable_grad(poses)
    return SphereTable(place, outward, poses, moving)


def _numbers(sphere: mi.Shape) -> tuple[mi.Float, ...]:
    """Row by row, attached if they are."""
    matrix = mi.traverse(sphere)[TO_WORLD].matrix
    return tuple(mi.Float(matrix[i, j]) for i in range(ROWS) for j in range(COLUMNS))
