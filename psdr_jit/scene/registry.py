"""Tables that lanes look up by the registry index of the shape that they have met."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from .instances import is_instance


def registry_table(scene: mi.Scene, chosen: set[int]) -> mi.UInt32:
    """By registry index of a shape: 1 if its number in `scene.shapes()` is among `chosen`; −1: every instance."""
    if -1 in chosen:
        chosen = chosen | {k for k, shape in enumerate(scene.shapes()) if is_instance(shape)}
    return registry_values(scene, {index: 1 for index in chosen if index >= 0})


def registry_indices(scene: mi.Scene) -> list[int]:
    """By number in `scene.shapes()`: the registry index."""
    return [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.shapes_dr())]


def registry_values(scene: mi.Scene, values: Mapping[int, int]) -> mi.UInt32:
    """By registry index of a shape: the value given for its number in `scene.shapes()`, or 0."""
    ids = registry_indices(scene)
    return values_by_registry({ids[index]: value for index, value in values.items()}, max(ids, default=0))


def values_by_registry(values: Mapping[int, int], last: int = 0) -> mi.UInt32:
    """By registry index: the value given for it, or 0, up to at least the index `last`."""
    table = [0] * (max(values, default=0) + 1)
    table += [0] * (last + 1 - len(table))
    for index, value in values.items():
        table[index] = value
    return mi.UInt32(table)
