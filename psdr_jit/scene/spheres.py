"""Where the spheres of a scene are."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..core.upload import uploaded


def spheres_of(scene: mi.Scene, indices: Sequence[int]) -> tuple[mi.Point3f, mi.Float]:
    """`(centres, radii)` in world space of the `sphere` shapes with these places in the scene, as they are now.

    Stored, one entry for each, detached. Scales are uniform: Mitsuba's spheres have no others.
    """
    columns = np.stack([np.array(mi.traverse(scene.shapes()[index])["to_world"].matrix, dtype=float).reshape(4, 4)
                        for index in indices])  # fmt: skip
    centres = mi.Point3f(*(uploaded(mi.Float, columns[:, i, 3]) for i in range(3)))
    return centres, uploaded(mi.Float, np.linalg.norm(columns[:, :3, 0], axis=1))
