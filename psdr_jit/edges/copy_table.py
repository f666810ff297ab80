"""Which copy (`copies.py`) stands for what an instance shows, looked up by what a ray has met.

What is known of shapes by number, tables of their kinds, poses and patterns, is known of copies as well: they are
shapes. Paths meet the instance itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import pointers
from ..core.memory import Slot
from ..core.surface_code import INSTANCED, MOST_INSTANCES, PART_SHIFT, parts_are_shapes, registry_index
from ..core.upload import uploaded
from ..plan.job import Job
from ..scene.registry import values_by_registry
from .edge_shapes import edge_shapes

#: Of one render call: the registry indices of its shapes, and its copies.
NUMBERS: Slot[np.ndarray | None] = Slot(lambda: None)
COPIES: Slot[CopyTable | None] = Slot(lambda: None)


@dataclass(frozen=True)
class CopyTable:
    """The copies of a scene. Host object; arrays are detached."""

    first: mi.UInt32  # by registry index of an instance: number of its first copy, from 1
    place: mi.UInt32  # by registry index of a shape in a group: its place there
    shape: mi.UInt32  # by number of a copy: its registry index

    @staticmethod
    def of(job: Job) -> CopyTable | None:
        """None if there are no instances. What an instance shows of grids has no copy: number 0. Made once per call."""
        return job.shared.once(COPIES, lambda: CopyTable._made(job))

    @staticmethod
    def _made(job: Job) -> CopyTable | None:
        found = edge_shapes(job)
        if not found.copies:
            return None
        ids, first, place, shape = shape_numbers(job), {}, {}, [0]
        for copy in found.copies:
            start = first.setdefault(int(ids[copy.instance]), len(shape))
            shape += [0] * (start + copy.place + 1 - len(shape))
            shape[start + copy.place] = int(ids[copy.index])
            place[registry_index(copy.child)] = copy.place
        return CopyTable(values_by_registry(first), values_by_registry(place), uploaded(mi.UInt32, np.array(shape)))

    def of_code(self, code: mi.UInt32) -> mi.UInt32:
        """Registry index of the shape, or the copy, with this `surface_code`; 0: none."""
        instanced = code >= INSTANCED
        part = (code & (INSTANCED - 1)) >> PART_SHIFT
        place = dr.gather(mi.UInt32, self.place, part, instanced) if parts_are_shapes() else part
        return dr.select(instanced, self._copy(code & (MOST_INSTANCES - 1), place, instanced), code)

    def of_surface(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        """The same of a surface that a ray has met."""
        shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance))
        instanced = si.is_valid() & (instance != 0)
        place = dr.gather(mi.UInt32, self.place, shape, instanced)
        return dr.select(instanced, self._copy(instance, place, instanced), shape)

    def _copy(self, instance: mi.UInt32, place: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        number = dr.gather(mi.UInt32, self.first, instance, active) + place
        return dr.gather(mi.UInt32, self.shape, number, active)


def code_of(copies: CopyTable | None, code: mi.UInt32) -> mi.UInt32:
    """Registry index of what has this `surface_code`, a copy in place of what an instance shows."""
    return code if copies is None else copies.of_code(code)


def number_of(copies: CopyTable | None, si: mi.SurfaceInteraction3f) -> mi.UInt32:
    """The same of a surface that a ray has met; 0: none."""
    number = dr.reinterpret_array(mi.UInt32, si.shape) if copies is None else copies.of_surface(si)
    return dr.select(si.is_valid(), number, 0)


def shape_numbers(job: Job) -> np.ndarray:
    """By number of a shape, copies included: its registry index. Asked for once per call."""
    return job.shared.once(NUMBERS, lambda: _shape_numbers(job))


def _shape_numbers(job: Job) -> np.ndarray:
    return np.array(dr.reinterpret_array(mi.UInt32, pointers(mi.ShapePtr, edge_shapes(job).shapes)))


def values_of_shapes(job: Job, values: Mapping[int, int]) -> mi.UInt32:
    """By registry index of a shape or a copy: the value given for its number in `edge_shapes`, or 0."""
    ids = shape_numbers(job)
    return values_by_registry({int(ids[index]): value for index, value in values.items()}, int(ids.max(initial=0)))
