"""What edges are made from: the shapes of a scene, and in place of each instance copies of the shapes that it shows.

`edge_shapes(job)` is the scene's own list of shapes with their facts where there are no instances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_buffers
from ..core.memory import Memory, Slot, same_arrays
from ..errors import UnsupportedError
from ..plan.job import Job
from ..scene.capabilities import COPIES
from ..scene.facts import ShapeFacts
from ..scene.instances import group_of, shape_groups
from ..scene.names import traverse
from ..scene.poses import on_host
from .copies import attributes, copied


@dataclass(frozen=True)
class EdgeShapes:
    """Shapes with a surface of their own."""

    shapes: tuple[mi.Shape, ...]  # by `ShapeFacts.index`; those of the scene come first
    facts: tuple[ShapeFacts, ...]  # of all but grids and the instances themselves
    grids: tuple[GridPlace, ...]  # grids of signed distances, which are not copied
    copies: tuple[CopyPlace, ...]  # of what instances show, instance by instance; none of grids


@dataclass(frozen=True)
class CopyPlace:
    """What a copy stands for."""

    index: int  # of the copy itself among the shapes
    instance: int  # index of the instance
    child: mi.Shape
    place: int  # of the shape in the group


@dataclass(frozen=True)
class GridPlace:
    """A grid of signed distances, by itself or as an instance shows it."""

    shape: mi.Shape
    facts: ShapeFacts
    instance: mi.Shape | None
    place: int  # of the shape in the group of the instance

    def id(self) -> str:
        return self.facts.name if self.instance is None else f"{self.instance.id()}: {self.facts.name}"

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return (self.shape if self.instance is None else self.instance).bbox()

    def is_mesh(self) -> bool:
        return False

    def to_world(self) -> np.ndarray:
        """Of the unit cube that the grid fills, (4, 4)."""
        matrix = np.eye(4)
        for shape in (self.instance, self.shape):
            if shape is not None:
                matrix = matrix @ on_host(mi.traverse(shape)["to_world"])
        return matrix


@dataclass(frozen=True)
class _Copy:
    """A shape as an instance shows it, and what it was made from, kept alive so that it can be told from another."""

    child: mi.Shape
    arrays: list
    shape: mi.Shape


#: Of one render call: its shapes.
SHAPES: Slot[EdgeShapes | None] = Slot(lambda: None)

#: Of an integrator: by number in `scene.shapes()`, an instance and the id of its group.
GROUPS: Slot[dict[int, tuple[mi.Shape, str]]] = Slot(dict)

#: Of an integrator: copies by the number of the instance and their place in the group.
KNOWN: Slot[dict[tuple[int, int], _Copy]] = Slot(dict)


def edge_shapes(job: Job) -> EdgeShapes:
    """The shapes of the scene as edges need them; copies are kept while what they show rests."""
    if job.shared[SHAPES] is None:
        job.shared[SHAPES] = _found(job)
    return job.shared[SHAPES]


def _found(job: Job) -> EdgeShapes:
    shapes = list(job.scene.shapes())
    facts = [s for s in job.facts.shapes if s.index >= 0 and s.kind not in ("instance", "grid")]
    grids = [GridPlace(shapes[s.index], s, None, 0) for s in job.facts.shapes if s.index >= 0 and s.kind == "grid"]
    instances = [s.index for s in job.facts.shapes if s.index >= 0 and s.kind == "instance"]
    copies: list[CopyPlace] = []
    if instances:
        groups = shape_groups(traverse(job.scene).hierarchy)
        members = {name: [s for s in job.facts.shapes if s.group == name] for name in groups}
        for index in instances:
            name = _group(job.call.memory, index, shapes[index], groups)
            for place, (child, of_child) in enumerate(zip(groups[name], members[name], strict=True)):
                if of_child.kind == "grid":
                    grids.append(GridPlace(child, of_child, shapes[index], place))
                    continue
                copy = _copy(job, (index, place), shapes[index], child, of_child)
                copies.append(CopyPlace(len(shapes), index, child, place))
                facts.append(replace(of_child, name=copy.id(), group="", index=len(shapes)))
                shapes.append(copy)
    return EdgeShapes(tuple(shapes), tuple(facts), tuple(grids), tuple(copies))


def _group(memory: Memory, index: int, instance: mi.Shape, groups: dict[str, list[mi.Shape]]) -> str:
    """Id of the group that an instance shows: always the same, and slow to ask for."""
    known = memory[GROUPS].get(index)
    if known is None or known[0] is not instance or known[1] not in groups:
        known = (instance, group_of(instance))
        memory[GROUPS][index] = known
    if known[1] not in groups:
        text = f"instance '{instance.id()}' shows shapegroup '{known[1]}', which the scene does not have"
        raise UnsupportedError(f"{text}; {COPIES}")
    return known[1]


def _copy(job: Job, key: tuple[int, int], instance: mi.Shape, child: mi.Shape, facts: ShapeFacts) -> mi.Shape:
    arrays = _arrays(instance, child)
    known = job.call.memory[KNOWN].get(key)
    if known is None or known.child is not child or not same_arrays(known.arrays, arrays):
        name = f"{job.facts.shapes[key[0]].name}: {facts.name}"
        known = _Copy(child, arrays, copied(child, facts.plugin, instance, name))
        job.call.memory[KNOWN][key] = known
    return known.shape


def _arrays(instance: mi.Shape, child: mi.Shape) -> list:
    """All that a copy depends on but for the BSDF, which it shares; whatever changes one replaces it by another."""
    places = [mi.traverse(instance)["to_world"]]
    arrays = []
    if child.is_mesh():
        arrays += [dr.detach(buffer) for buffer in (*mesh_buffers(child), *attributes(child).values())]
    else:
        places.append(mi.traverse(child)["to_world"])
    return arrays + [dr.detach(place.matrix[i, j]) for place in places for i in range(3) for j in range(4)]
