"""Patches of surfaces with bump or normal maps, as rows of an edge table.

Which patches there are depends on texture coordinates and the sizes of pictures alone: it is kept while shapes move.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import faces_buffer, mesh_faces, same_values, texcoords_buffer
from ..core.memory import Memory, Slot
from ..core.upload import uploaded
from ..scene.bent_normals import BentMap, bent_maps
from ..scene.facts import ShapeFacts
from ..scene.graph import is_piecewise_constant
from ..scene.names import plugin_name
from .pattern_rows import Patches
from .pattern_shapes import body_patches, face_patches, texcoords, winding


@dataclass
class BentRows:
    """One entry per row; detached device arrays."""

    shape: mi.UInt32  # index into the shapes of the kind
    part: mi.UInt32  # the face of a mesh, or which sort of shape
    map: mi.UInt32  # index into the maps of the kind
    v0: mi.UInt32  # of a mesh: the corners of its face, by global vertex index
    v1: mi.UInt32
    v2: mi.UInt32
    q0: mi.Point2f  # corners of the patch in the surface's own coordinates
    q1: mi.Point2f
    q2: mi.Point2f
    w0: mi.Point2f  # the same in texel coordinates (`bent_texels`), 0 of a map without texels
    w1: mi.Point2f
    w2: mi.Point2f
    texels: mi.Float  # of the map, from one end of the patch to the other
    steps: mi.Bool  # do bent normals step from texel to texel?
    front: mi.Bool  # may it be looked at from the side of its normals (`BentSurface.normal`)?
    back: mi.Bool  # and from the other one?
    mirrored: mi.Bool  # as of `BentMap`
    moves: mi.Bool  # can the shape move?

    def q(self, b: mi.Point2f) -> mi.Point2f:
        """The point b of the patches, in the surface's own coordinates."""
        return mi.Point2f(self.q0 + b.x * (self.q1 - self.q0) + b.y * (self.q2 - self.q0))


@dataclass(frozen=True)
class _Known:
    """The patches of a shape, and what they were made from."""

    buffers: list
    sizes: list[np.ndarray]  # of maps, as of `_scale`
    patches: Patches
    front: float  # of a mesh, as of `ShapePatterns`; else 0

    def is_of(self, buffers: list, sizes: list[np.ndarray]) -> bool:
        same = len(sizes) == len(self.sizes) and all(map(np.array_equal, sizes, self.sizes))
        return same and all(same_values(a, b) for a, b in zip(self.buffers, buffers, strict=True))


@dataclass(frozen=True)
class _Table:
    """Rows, and what they were made from: patches and maps, kept alive, and which shapes move."""

    of_shapes: list[_Known]
    maps: list[BentMap]
    moves: list[bool]
    rows: BentRows

    def is_of(self, of_shapes: list[_Known], maps: list[BentMap], moves: list[bool]) -> bool:
        same = [id(known) for known in of_shapes] == [id(known) for known in self.of_shapes]
        return same and [id(m.node) for m in maps] == [id(m.node) for m in self.maps] and moves == self.moves


#: Patches of all shapes together, about: at least; and at most, until when they are as small as texels. No fewer than
#: faces.
LEAST_PATCHES, MOST_PATCHES = 4096, 2**16

#: Of an integrator: patches by name of the shape.
PATCHES: Slot[dict[str, _Known]] = Slot(dict)

#: Of an integrator: the tables last made, of meshes and of others.
TABLES: Slot[dict[bool, _Table]] = Slot(dict)


def bent_rows(
    chosen: list[tuple[mi.Shape, ShapeFacts]], memory: Memory
) -> tuple[BentRows, tuple[BentMap, ...], list[float]]:
    """Rows of `chosen` shapes with maps, all of them meshes or none; their maps; and by shape `ShapePatterns.front`, or
    0 if it is no mesh. Kept from call to call.

    `front` and `back` are as the BSDF has them.
    """
    own_maps = [bent_maps(shape.bsdf()) for shape, _ in chosen]
    of_shapes = [_patches(shape, facts, maps, 1 / len(chosen), memory)
                 for (shape, facts), maps in zip(chosen, own_maps, strict=True)]  # fmt: skip
    maps, moves = [bent for own in own_maps for bent in own], [facts.moves for _, facts in chosen]
    meshes = chosen[0][1].is_mesh
    table = memory[TABLES].get(meshes)
    if table is None or not table.is_of(of_shapes, maps, moves):
        table = _Table(of_shapes, maps, moves, _joined_rows(chosen, own_maps, of_shapes))
        memory[TABLES][meshes] = table
    return table.rows, tuple(maps), [known.front for known in of_shapes]


def _joined_rows(
    chosen: list[tuple[mi.Shape, ShapeFacts]], own_maps: list[list[BentMap]], of_shapes: list[_Known]
) -> BentRows:
    columns: dict[str, list[np.ndarray]] = {}
    first, before = 0, 0
    for number, ((shape, facts), maps, known) in enumerate(zip(chosen, own_maps, of_shapes, strict=True)):
        cut, corners = known.patches, None
        if facts.is_mesh:
            corners = np.array(mesh_faces(shape)).T[cut.part] + first
            first += shape.vertex_count()
        for place, bent in enumerate(maps, before):
            front, back = (bent.back, bent.front) if known.front < 0 else (bent.front, bent.back)
            own = _columns(cut, corners) | {
                "texels": _texels(bent.texture, cut.uv), "shape": number, "map": place, "mirrored": bent.mirrored,
                "steps": bent.steps, "moves": facts.moves, "front": front, "back": back,
            } | _texel_coordinates(bent.texture, cut.uv)  # fmt: skip
            for name, values in own.items():
                alike = np.broadcast_to(values, len(cut.part)) if np.ndim(values) == 0 else values
                columns.setdefault(name, []).append(alike)
        before += len(maps)
    return BentRows(**{name: _on_device(name, np.concatenate(parts)) for name, parts in columns.items()})


def _columns(patches: Patches, corners: np.ndarray | None) -> dict[str, np.ndarray]:
    count = len(patches.part)
    corners = np.zeros((count, 3), int) if corners is None else corners
    own = {f"v{k}": corners[:, k] for k in range(3)} | {f"q{k}": patches.q[:, k] for k in range(3)}
    return own | {"part": patches.part}


def _on_device(name: str, values: np.ndarray):
    if values.ndim == 2:
        return mi.Point2f(*(uploaded(mi.Float, values[:, axis]) for axis in range(2)))
    if values.dtype == bool:
        return uploaded(mi.Bool, values)
    return uploaded(mi.Float if name == "texels" else mi.UInt32, values)


def _patches(shape: mi.Shape, facts: ShapeFacts, maps: list[BentMap], share: float, memory: Memory) -> _Known:
    """`share`: of all patches."""
    textures = [bent.texture for bent in maps]
    buffers = [dr.detach(texcoords_buffer(shape)), faces_buffer(shape)] if facts.is_mesh else []
    known, sizes = memory[PATCHES].get(facts.name), [_scale(texture) for texture in textures]
    if known is None or not known.is_of(buffers, sizes):
        front = winding(shape) if facts.is_mesh else 0.0
        known = _Known(buffers, sizes, _cut(shape, facts, textures, share), front)
        memory[PATCHES][facts.name] = known
    return known


def _cut(shape: mi.Shape, facts: ShapeFacts, textures: list[mi.Texture], share: float) -> Patches:
    """A shape in patches, about as small as texels."""
    if not facts.is_mesh:
        whole = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
        cells = max(float(_texels(texture, whole)[0]) for texture in textures) ** 2
        side = int(np.ceil(np.sqrt(np.clip(2 * cells, share * LEAST_PATCHES, share * MOST_PATCHES) / 2)))
        return body_patches(facts.plugin, (side, side))
    uv = texcoords(shape)
    cells = sum(np.max([_texels(texture, uv) for texture in textures], 0) ** 2)
    wanted = np.clip(cells, share * LEAST_PATCHES, share * MOST_PATCHES)
    return face_patches(uv, max(1, int(np.sqrt(wanted / max(len(uv), 1)))))


def _scale(texture: mi.Texture) -> np.ndarray:
    """Texels as an affine function of texture coordinates, (2, 3); 0 where there are none."""
    if plugin_name(texture) != "bitmap":
        return np.zeros((2, 3))
    params = mi.traverse(texture)
    height, width = dr.shape(params["data"])[:2]
    return np.array(params["to_uv"].matrix, float)[:2, :3] * np.array([[width], [height]])


def _texel_coordinates(texture: mi.Texture, uv: np.ndarray) -> dict[str, np.ndarray]:
    """Of the corners of patches with texture coordinates (P, 3, 2), as columns."""
    scale = _scale(texture)
    centres = scale.any() and not is_piecewise_constant(texture, "bitmap")
    return {f"w{k}": uv[:, k] @ scale[:, :2].T + scale[:, 2] - 0.5 * centres for k in range(3)}


def _texels(texture: mi.Texture, uv: np.ndarray) -> np.ndarray:
    """How many texels patches with texture coordinates (P, 3, 2) are long or wide."""
    return np.abs((uv - np.roll(uv, 1, 1)) @ _scale(texture)[:, :2].T).max((1, 2))
