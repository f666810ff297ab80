"""Which object of a scene file became which object of the loaded scene.

Mitsuba keeps no record of it. Children with a name are found by that name, others by their kind and place, the scene's
own by their ids first. A mistake here would be seen when what was written is read again (`write`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from psdr_jit.export.tree import UNNAMED, Node, Reference
from psdr_jit.scene.graph import named_children


@dataclass(frozen=True)
class Slot:
    """A place in the file with a colour or a number, of which Mitsuba has made an object; it may be left out there."""

    node: Node
    key: str


def owners(scene: mi.Scene, tree: Node) -> dict[Any, Node | Slot]:
    """The file's objects by those of the scene."""
    by_id = {node.id: node for node in tree.walk() if node.id}
    found: dict[Any, Node | Slot] = {}
    todo = [(scene, tree)]
    while todo:
        owner, node = todo.pop()
        for child, place in _paired(owner, node, by_id):
            if child not in found:  # a shared one is the file's first
                found[child] = place
                if isinstance(place, Node):
                    todo.append((child, place))
    return found


def _paired(owner: Any, node: Node, by_id: dict[str, Node]) -> Iterable[tuple[Any, Node | Slot]]:
    """The children of an object, each with its place in the file."""
    children = named_children(owner)
    unnamed = [_followed(value, by_id) for name, value in node.entries.items() if name.startswith(UNNAMED)]
    unnamed = [value for value in unnamed if value is not None]
    left = []
    for name, child in children:
        given = by_id.get(child.id()) if node.tag == "scene" else _followed(node.entries.get(name), by_id)
        if given is not None:
            unnamed = [value for value in unnamed if value is not given]
            yield child, given
        else:
            left.append((name, child))
    for name, child in left:
        first = next((value for value in unnamed if _fits(child, value)), None)
        if first is not None:
            unnamed = [value for value in unnamed if value is not first]
            yield child, first
        elif isinstance(child, mi.Texture):
            yield child, Slot(node, name)


def _followed(value: Any, by_id: dict[str, Node]) -> Node | None:
    return by_id.get(value.id) if isinstance(value, Reference) else value if isinstance(value, Node) else None


def _fits(child: Any, node: Node) -> bool:
    kinds = {"sensor": mi.Sensor, "film": mi.Film, "emitter": mi.Emitter, "sampler": mi.Sampler, "shape": mi.Shape,
             "texture": mi.Texture, "volume": mi.Volume, "medium": mi.Medium, "bsdf": mi.BSDF,
             "integrator": mi.Integrator, "phase": mi.PhaseFunction,
             "rfilter": mi.ReconstructionFilter}  # fmt: skip
    return isinstance(child, kinds[node.tag])
