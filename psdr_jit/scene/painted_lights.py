"""Painted area lights that Mitsuba samples wrongly: the image of `path` itself is wrong, and its derivative has no
value to compare with.

Mitsuba 3.9 chooses points of a light with a texture by their place in the texture, and takes the first point of the
shape that it finds there for the only one. Of a `cube`, whose faces all show the whole texture, one face is sampled.
And what a light with an attribute of its mesh sends from a point that has been sampled is looked up without the face.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, texcoords_buffer
from ..core.memory import Memory, Slot, key_of, while_unchanged
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts
from .graph import child_objects
from .names import plugin_name

#: By how much the faces may cover their part of the texture more than once, relative to its size: rounding.
TOLERANCE = 1e-3

#: Of an integrator: by light, its arrays, and whether its faces overlap in the texture.
OVERLAPS: Slot[dict[str | int, tuple[list, bool]]] = Slot(dict)


def warn_about_painted_lights(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> None:
    """Name painted lights whose faces, taken together, are larger than the part of the texture that they show."""
    painted = [e.shape for e in facts.emitters if e.plugin == "area" and e.varies and e.shape >= 0]
    for shape in (facts.shapes[k] for k in painted if facts.shapes[k].index >= 0):
        mesh = scene.shapes()[shape.index]
        if any(plugin_name(texture) == "mesh_attribute" for texture in child_objects(mesh.emitter())):
            warn_once(
                f"the area light '{shape.name}' has the colours of a mesh attribute: Mitsuba looks them up at wrong "
                "places where it samples the light, so that the image itself is wrong; use a bitmap",
                UnsupportedWarning,
                memory,
            )
        elif shape.is_mesh and shape.has_texcoords and _overlap(mesh, memory):
            warn_once(
                f"the area light '{shape.name}' has a texture, and several of its points have the same texture "
                "coordinates: Mitsuba samples one of them only, so that the image itself is wrong; give every point a "
                "place of its own in the texture, or make a light of each face",
                UnsupportedWarning,
                memory,
            )


def _overlap(mesh: mi.Mesh, memory: Memory) -> bool:
    buffers = [dr.detach(texcoords_buffer(mesh)), dr.detach(faces_buffer(mesh))]
    kept = memory[OVERLAPS]
    return while_unchanged(kept, key_of(mesh), buffers, lambda: _covers_twice(*(np.array(b) for b in buffers)))


def _covers_twice(texcoords: np.ndarray, faces: np.ndarray) -> bool:
    uv = texcoords.reshape(-1, 2).astype(float)
    a, b, c = (uv[faces.reshape(-1, 3)[:, corner]] for corner in range(3))
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2
    return bool(area > np.prod(uv.max(0) - uv.min(0)) * (1 + TOLERANCE))
