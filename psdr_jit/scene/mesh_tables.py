"""The meshes of a scene as tables, from which a surface is looked up whichever mesh it is on.

Mitsuba's `compute_surface_interaction` is a virtual call: Dr.Jit records the function of every shape anew, with its
adjoint, each time a surface is asked for. In a scene of a hundred meshes that is four fifths of a derivative's time
outside of kernels. With all vertices in one array and all faces in another it is a few gathers, whose number does not
depend on the scene (`paths.mesh_surface`).

Of meshes that move, vertices are read from arrays of their own, variables which stand for Mitsuba's while a render call
lasts: in forward mode they take over the tangents before the terms run, in backward mode they hand on what they have
gathered after that. A loop can add to the gradient of a variable, and not to that of what was computed outside of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ad import backpropagate, tangents
from ..core.compat import faces_buffer, vertex_buffers
from ..core.joining import joined, starts
from ..core.memory import Memory, Slot, while_unchanged
from ..core.upload import uploaded
from ..core.varying import varying
from .registry import registry_indices, registry_values
from .sphere_table import SphereTable, is_sphere, sphere_table

#: What is known of a shape; bits of `MeshTables.traits`.
SMOOTH, TEXTURED, FLIPPED, MOVES = (1 << k for k in range(4))

#: Shapes from which on tables cost less than calls. Kernels of three take up to a tenth longer with them, of ten a
#: twentieth less; what is recorded, and so the time outside of kernels and that of compiling them, grows with every
#: shape that a call knows.
FEWEST = 6

#: Tables that an integrator keeps: of scenes, and of what moves in them.
KEPT = 4

#: Of an integrator: the tables of meshes that rest.
TABLES: Slot[dict] = Slot(dict)


@dataclass(frozen=True)
class Vertices:
    """Vertices of meshes, mesh after mesh, flat. Meshes without normals or texture coordinates have zeros there."""

    positions: mi.Float
    normals: mi.Float
    texcoords: mi.Float


class CallVariables(Protocol):
    """Variables that stand for arrays of Mitsuba's while a render call lasts."""

    def take_tangents(self) -> None:
        """Give them the tangents of Mitsuba's arrays: before the terms run in forward mode."""

    def hand_on(self) -> None:
        """Add their gradients to those of Mitsuba's arrays: after the terms have run in backward mode."""


FIELDS = tuple(field.name for field in fields(Vertices))


@dataclass(frozen=True)
class Moving:
    """Meshes whose vertices are differentiated; host object."""

    sources: tuple[Vertices, ...]  # Mitsuba's arrays, by mesh
    vertices: Vertices  # variables of their own in place of them

    def take_tangents(self) -> None:
        """Give the variables the tangents of Mitsuba's arrays."""
        with dr.resume_grad():
            for name in FIELDS:
                variable = getattr(self.vertices, name)
                if dr.grad_enabled(variable):
                    dr.set_grad(variable, joined([tangents(getattr(source, name)) for source in self.sources]))

    def hand_on(self) -> None:
        """Add the gradients of the variables to those of Mitsuba's arrays."""
        with dr.resume_grad():
            for name in FIELDS:
                start, grad = 0, dr.grad(getattr(self.vertices, name))
                for source in self.sources:
                    array = getattr(source, name)
                    size = dr.width(array)
                    if dr.grad_enabled(array):
                        part = dr.gather(mi.Float, grad, dr.arange(mi.UInt32, size) + varying(mi.UInt32, start))
                        backpropagate(array * varying(mi.Float, 1), part)
                    start += size


@dataclass(frozen=True)
class MeshTables:
    """The meshes of a scene of meshes and spheres, by registry index; and their vertices. Detached but for what moves.
    """

    traits: mi.UInt32  # what is known of it
    first_face: mi.UInt32  # the number of its first face among all
    shift: mi.UInt32  # of a mesh that moves: from numbers of vertices among all to numbers among those that move
    faces: mi.UInt32  # numbers of vertices among all: corners of all faces, flat
    vertices: Vertices  # of all
    moving: Moving | None
    smooth: bool  # do some have vertex normals?
    textured: bool  # do some have texture coordinates?
    spheres: SphereTable | None = None

    def in_motion(self) -> list[CallVariables]:
        """What has variables that take over tangents, and hand on gradients."""
        spheres = self.spheres is not None and self.spheres.moving
        return [*([self.moving] if self.moving is not None else []), *([self.spheres] if spheres else [])]


def mesh_tables(scene: mi.Scene, memory: Memory) -> MeshTables | None:
    """The tables of a scene of meshes and spheres; None if there are other shapes, no meshes, or few of them.

    They are made anew only when an array of a mesh that rests has been replaced.
    """
    shapes = scene.shapes()
    meshes = [shape for shape in shapes if shape.is_mesh()]
    if len(shapes) < FEWEST or not meshes or not all(shape.is_mesh() or is_sphere(shape) for shape in shapes):
        return None
    chosen = [k for k, shape in enumerate(shapes) if shape.is_mesh()]
    with dr.resume_grad():
        moves = [dr.grad_enabled(vertex_buffers(mesh)) for mesh in meshes]
        moving = _moving([mesh for mesh, own in zip(meshes, moves, strict=True) if own]) if any(moves) else None
    traits = [_traits(mesh) | (MOVES if own else 0) for mesh, own in zip(meshes, moves, strict=True)]
    arrays = [faces_buffer(mesh) for mesh in meshes]
    arrays += [buffer for mesh, own in zip(meshes, moves, strict=True) if not own for buffer in vertex_buffers(mesh)]
    ids = registry_indices(scene)
    with dr.suspend_grad():
        key = (*ids, *chosen, *traits)
        tables = while_unchanged(memory[TABLES], key, arrays, lambda: _tables(scene, chosen, traits), KEPT)
    return replace(tables, moving=moving, spheres=sphere_table(scene, ids, memory, KEPT))


def _traits(mesh: mi.Mesh) -> int:
    found = 0
    for trait, there in ((SMOOTH, mesh.has_vertex_normals()), (TEXTURED, mesh.has_vertex_texcoords()),
                         (FLIPPED, mesh.has_flipped_normals())):  # fmt: skip
        found |= trait if there else 0
    return found


def _vertices(mesh: mi.Mesh) -> Vertices:
    """Mitsuba's arrays, attached if they are, and zeros in place of those that it does not have."""
    sizes = (3 * mesh.vertex_count(), 3 * mesh.vertex_count(), 2 * mesh.vertex_count())
    return Vertices(*(array if dr.width(array) == size else dr.zeros(mi.Float, size)
                      for array, size in zip(vertex_buffers(mesh), sizes, strict=True)))  # fmt: skip


def _joined(parts: Sequence[Vertices]) -> Vertices:
    """Detached and evaluated."""
    found = Vertices(*(mi.Float(joined([dr.detach(getattr(part, name)) for part in parts])) for name in FIELDS))
    dr.eval(found)
    return found


def _moving(meshes: Sequence[mi.Mesh]) -> Moving:
    sources = tuple(_vertices(mesh) for mesh in meshes)
    own = _joined(sources)
    for name in FIELDS:
        arrays = [getattr(source, name) for source in sources]
        if dr.grad_enabled(arrays):
            dr.enable_grad(getattr(own, name))
    return Moving(sources, own)


def _tables(scene: mi.Scene, chosen: Sequence[int], traits: Sequence[int]) -> MeshTables:
    """Without what moves, and spheres. `chosen`: numbers of the meshes in `scene.shapes()`."""
    meshes = [scene.shapes()[k] for k in chosen]
    vertices = np.array([mesh.vertex_count() for mesh in meshes])
    moves = np.array(traits) & MOVES != 0
    shift = starts(np.where(moves, vertices, 0)) - starts(vertices)
    corners = joined_corners(meshes)
    dr.eval(corners)

    def by_shape(values: Sequence[int] | np.ndarray) -> mi.UInt32:
        # differences below 0 wrap around, and back where they are added
        return registry_values(scene, {k: int(value) % 2**32 for k, value in zip(chosen, values, strict=True)})

    first_face = starts([mesh.face_count() for mesh in meshes])
    return MeshTables(by_shape(traits), by_shape(first_face), by_shape(shift), corners,
                      _joined([_vertices(mesh) for mesh in meshes]), None, any(t & SMOOTH for t in traits),
                      any(t & TEXTURED for t in traits))  # fmt: skip


def joined_corners(meshes: Sequence[mi.Mesh]) -> mi.UInt32:
    """Corners of all faces, flat, as numbers of vertices of all meshes."""
    vertices, faces = ([count(mesh) for mesh in meshes] for count in (mi.Mesh.vertex_count, mi.Mesh.face_count))
    flat = joined([faces_buffer(mesh) for mesh in meshes])
    return flat + uploaded(mi.UInt32, np.repeat(starts(vertices), 3 * np.array(faces)))
