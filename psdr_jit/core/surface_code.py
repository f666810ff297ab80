"""Which surface a ray has met, in one whole number: a shape of the scene, or a shape that an instance shows.

    0                                          none
    registry index                             a shape of the scene, below 2³¹
    2³¹ | (part << 16) | registry index        of an instance, and which shape of its group

Records keep this number per path vertex: instances make them no larger. `part` is what Mitsuba needs to find the shape
again, which is its place in the group where Embree traces rays, and its registry index where OptiX does.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

INSTANCED = 1 << 31
"""Set in the codes of what instances show."""

PART_SHIFT = 16
"""Bits for the instance."""

MOST_INSTANCES, MOST_PARTS = 1 << PART_SHIFT, 1 << (31 - PART_SHIFT)
"""Registry indices of instances, and parts, must be below these."""


def registry_index(shape: mi.Shape) -> int:
    """The number that no other living shape has. On the host, as it is: no kernel runs."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def parts_are_shapes() -> bool:
    """Is a part known by its registry index (OptiX), or by its place in the group (Embree)?"""
    return dr.backend_v(mi.Float) == dr.JitBackend.CUDA


def top_level(pi: mi.PreliminaryIntersection3f | mi.SurfaceInteraction3f) -> mi.UInt32:
    """Registry index of what `scene.shapes()` lists, a shape or an instance; 0 if nothing was met."""
    shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (pi.shape, pi.instance))
    return dr.select(instance != 0, instance, shape)


def top_level_of(code: mi.UInt32) -> mi.UInt32:
    """The same of what has this `surface_code`."""
    return dr.select(code >= INSTANCED, code & (MOST_INSTANCES - 1), code)


def surface_code(pi: mi.PreliminaryIntersection3f) -> mi.UInt32:
    """Code of the surface that was met."""
    shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (pi.shape, pi.instance))
    part = shape if parts_are_shapes() else pi.shape_index
    code = dr.select(instance != 0, INSTANCED | (part << PART_SHIFT) | instance, shape)
    return dr.select(pi.is_valid(), code, 0)


def set_surface(pi: mi.PreliminaryIntersection3f, code: mi.UInt32) -> None:
    """Let `pi` be on the surface with this code."""
    instanced = code >= INSTANCED
    part = (code & (INSTANCED - 1)) >> PART_SHIFT
    pi.instance = dr.reinterpret_array(mi.ShapePtr, dr.select(instanced, code & (MOST_INSTANCES - 1), 0))
    if parts_are_shapes():
        pi.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(instanced, part, code))
    else:
        pi.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(instanced, 0, code))
        pi.shape_index = part  # of no meaning, and not asked for, where there is no instance
