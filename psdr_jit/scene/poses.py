"""Where analytic shapes are: their object-to-world maps as arrays."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi


def attached_to_world(shapes: tuple[mi.Shape, ...], index: mi.UInt32) -> tuple[mi.Vector3f, ...]:
    """Columns (x, y, z axis, origin) of each lane's object-to-world map, attached to the shapes' `to_world`."""
    matrices = [mi.traverse(shape)["to_world"].matrix for shape in shapes]

    def column(j: int) -> mi.Vector3f:
        entries = (dr.concat([mi.Float(m[i, j]) for m in matrices]) for i in range(3))
        return mi.Vector3f(*(dr.gather(mi.Float, entry, index) for entry in entries))

    return tuple(column(j) for j in range(4))


def spheres_of(scene: mi.Scene, indices: Sequence[int]) -> tuple[mi.Point3f, mi.Float]:
    """`(centres, radii)` in world space of the `sphere` shapes with these places in the scene, as they are now.

    Stored, one entry for each, detached. Scales are uniform: Mitsuba's spheres have no others.
    """
    shapes = scene.shapes()
    found = tuple(shapes[index] for index in indices)
    x_axis, _, _, centre = attached_to_world(found, dr.arange(mi.UInt32, len(found)))
    centres, radii = mi.Point3f(dr.detach(centre)), dr.detach(dr.norm(x_axis))
    dr.make_opaque(centres, radii)
    return centres, radii
