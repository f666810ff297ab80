"""Names of scene parameters that mean the same in every process.

Mitsuba calls an object without an `id` by its address. Here it is called by its type and its place among the scene's
own objects of that type, from 0 on: `shape[3].vertex_positions`, or `sensor.to_world` where there is one sensor only.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any

import mitsuba as mi

from psdr_jit.scene.capabilities import PLUGIN_NAMES
from psdr_jit.scene.guard import require_variant

ADDRESS = re.compile(r"(object_\d+|_unnamed_\d+)(_\d+)?")
"""What Mitsuba calls objects without an id: `object_94174662291344`."""


def plugin_name(node: mi.Object) -> str:
    """The name that creates this object in a scene file; the C++ class name if it is not known."""
    known = node.class_name().split("[")[0]  # "BitmapTextureImpl[float32]"
    return PLUGIN_NAMES.get(known, known)


def shown_name(shape: mi.Shape) -> str:
    """What messages call a shape: its id or, as files leave many without one, what it is."""
    if shape.id():
        return shape.id()
    return f"unnamed {plugin_name(shape)}" + (f" of {shape.face_count()} faces" if shape.is_mesh() else "")


def traverse(scene: Any, spellings: Iterable[str] = ()) -> Any:
    """`mi.traverse(scene)` with stable names: `mi.SceneParameters`, in the same order.

    `spellings`: other accepted names of parameters, such as `shape[0].to_world` of a shape that has an id. The object
    that such a name belongs to is found under its spelling as well.
    """
    require_variant(scene, "the scene")
    params = mi.traverse(scene)
    objects = _scene_objects(params)
    prefixes = _stable(objects)
    found = {_renamed(name, prefixes): entry for name, entry in params.properties.items()}
    for spelling in spellings:
        known = not isinstance(spelling, str) or spelling in found
        key = None if known else _lookup(objects, prefixes, params, spelling)
        if key is not None:
            own, asked = key.split(".")[0], spelling.split(".")[0]
            found |= {asked + name[len(own):]: entry for name, entry in found.items() if name.split(".")[0] == own}
    return type(params)(found, params.hierarchy)


def stable_name(scene: Any, name: str) -> str:
    """The key in `traverse(scene)` of a parameter given by any of its names; `name` itself if it has none.

    Accepted are that key, Mitsuba's own name in this process, the type with the place (`shape[3]`) of an object with an
    id as well, and the type alone for the first of its kind.
    """
    params = mi.traverse(scene)
    objects = _scene_objects(params)
    found = _lookup(objects, _stable(objects), params, name) if isinstance(name, str) else None
    return name if found is None else found


def _lookup(objects: dict[str, tuple[str, int]], prefixes: dict[str, str], params: Any, name: str) -> str | None:
    """The stable name behind an accepted one; None if there is no such parameter."""
    first, dot, rest = name.partition(".")
    by_place = {f"{kind}[{k}]": old for old, (kind, k) in objects.items()}
    by_place |= {kind: old for old, (kind, k) in objects.items() if k == 0}
    stable = {new: old for old, new in prefixes.items()}
    old = stable.get(first, first if first in prefixes else by_place.get(first, first))   # ids come first
    return _renamed(old + dot + rest, prefixes) if old + dot + rest in params.properties else None


def _renamed(name: str, prefixes: dict[str, str]) -> str:
    first, dot, rest = name.partition(".")
    return prefixes.get(first, first) + dot + rest


def _scene_objects(params: Any) -> dict[str, tuple[str, int]]:
    """Type and place of the objects that the scene holds directly, by the first part of Mitsuba's names."""
    kinds = ((mi.Sensor, "sensor"), (mi.Emitter, "emitter"), (mi.BSDF, "bsdf"), (mi.Medium, "medium"),
             (mi.Shape, "shape"), (mi.Texture, "texture"))
    places, counts = {}, {}
    for node, (_, depth) in params.hierarchy.items():
        if depth == 1:
            kind = next((name for cls, name in kinds if isinstance(node, cls)), "object")
            counts[kind] = counts.get(kind, -1) + 1
            places[node] = (kind, counts[kind])
    found = {}
    for name, (_, _, node, _) in params.properties.items():
        while node not in places and params.hierarchy[node][0] is not None:
            node = params.hierarchy[node][0]
        if node in places:
            found[name.split(".")[0]] = places[node]
    return found


def _stable(objects: dict[str, tuple[str, int]]) -> dict[str, str]:
    """The stable form of the first part of each name: Mitsuba's own if that is an id, or if the other one is."""
    counts = Counter(kind for kind, _ in objects.values())
    found = {}
    for old, (kind, place) in objects.items():
        new = kind if counts[kind] == 1 and kind not in objects else f"{kind}[{place}]"
        found[old] = new if ADDRESS.fullmatch(old) and new not in objects else old
    return found
