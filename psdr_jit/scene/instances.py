"""Instances: shapes that show all shapes of a group, each at a place of its own.

Mitsuba hands out a group's shapes as children of the group, but an instance does not say which group it shows. That is
read from its description, where the group goes by its id.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import mitsuba as mi

from ..core.surface_code import MOST_INSTANCES, MOST_PARTS, parts_are_shapes, registry_index
from ..errors import UnsupportedError
from .capabilities import COPIES
from .graph import child_objects
from .names import plugin_name

GROUP_NAME = re.compile(r'ShapeGroup\[\s*name = "([^"\n]*)"')


def is_instance(shape: mi.Shape) -> bool:
    return plugin_name(shape) == "instance"


def group_shapes(group: mi.Shape) -> list[mi.Shape]:
    """The shapes of a group."""
    return [child for child in child_objects(group) if isinstance(child, mi.Shape)]


def shape_groups(nodes: Iterable[mi.Object]) -> dict[str, list[mi.Shape]]:
    """By its id, the shapes of every group among `nodes`. Raises `UnsupportedError` if groups share an id."""
    found = {}
    for node in nodes:
        if plugin_name(node) == "shapegroup":
            if node.id() in found:
                raise UnsupportedError(
                    f"two shapegroups have the id '{node.id()}', so it is not known which one an instance shows; give "
                    "each an id of its own"
                )
            found[node.id()] = group_shapes(node)
    return found


def group_of(instance: mi.Shape) -> str:
    """Id of the group that an instance shows."""
    found = GROUP_NAME.search(str(instance))
    if found is None:
        raise UnsupportedError(f"instance '{instance.id()}' does not tell what it shows; {COPIES}")
    return found.group(1)


def require_codes(instances: list[mi.Shape], groups: dict[str, list[mi.Shape]]) -> None:
    """Raise `UnsupportedError` if there are more instances, or shapes in groups, than `core.surface_code` holds."""
    if not instances:
        return
    parts = max((len(shapes) for shapes in groups.values()), default=0)
    if parts_are_shapes():
        parts = max((registry_index(shape) for shapes in groups.values() for shape in shapes), default=0)
    if max(registry_index(instance) for instance in instances) >= MOST_INSTANCES or parts >= MOST_PARTS:
        raise UnsupportedError(
            f"a path cannot tell more than {MOST_INSTANCES - 1} instances, or {MOST_PARTS - 1} shapes in groups, from "
            f"each other (all scenes that are loaded count); {COPIES}, or merge meshes"
        )
