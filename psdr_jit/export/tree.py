"""A scene file as a tree that can be changed: what Mitsuba's parser reads, with `$defaults` and includes resolved.

Mitsuba's own writer (`mi.parser.write_file`) leaves ids out and takes poses apart, which rounds them. Here numbers keep
all their digits: 17 of double precision, as the parser holds them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.sax.saxutils import quoteattr

import mitsuba as mi
import numpy as np

from psdr_jit.errors import SceneError, UnsupportedError

#: What the parser calls children without a name.
UNNAMED = "_arg_"

INDENT = "    "

#: Elements by what they make, as in `mi.ObjectType`.
TAGS = {
    "Scene": "scene", "Sensor": "sensor", "Film": "film", "Emitter": "emitter", "Sampler": "sampler", "Shape": "shape",
    "Texture": "texture", "Volume": "volume", "Medium": "medium", "BSDF": "bsdf", "Integrator": "integrator",
    "PhaseFunction": "phase", "ReconstructionFilter": "rfilter",
}  # fmt: skip


@dataclass(eq=False)
class Node:
    """An object of a scene file. `entries`: properties and children by name, in the file's order."""

    tag: str
    plugin: str
    id: str
    entries: dict[str, Any] = field(default_factory=dict)

    def drop(self, *names: str) -> None:
        for name in names:
            self.entries.pop(name, None)

    def children(self) -> Iterator[tuple[str, Node]]:
        for name, value in self.entries.items():
            if isinstance(value, Node):
                yield name, value

    def walk(self) -> Iterator[Node]:
        """This object and all below."""
        yield self
        for _, child in self.children():
            yield from child.walk()


@dataclass(frozen=True)
class Reference:
    """To an object with an id."""

    id: str


@dataclass(frozen=True)
class Colour:
    """An <rgb>."""

    rgb: tuple[float, float, float]


@dataclass(frozen=True)
class Spectrum:
    """A <spectrum>: one value for all wavelengths, or some by wavelength [nm]."""

    values: tuple[float, ...]
    wavelengths: tuple[float, ...] = ()


@dataclass(frozen=True)
class Vector:
    """A <vector> or <point>."""

    xyz: tuple[float, float, float]


def read(path: str | os.PathLike, **defaults: Any) -> Node:
    """The scene of a file. Raises `SceneError` if it cannot be parsed, `UnsupportedError` for what has no element."""
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_file(config, os.fspath(path), **{k: str(v) for k, v in defaults.items()})
        mi.parser.transform_upgrade(config, state)
    except (RuntimeError, UnicodeDecodeError) as error:
        raise SceneError(f"scene file '{path}' cannot be parsed: {str(error).splitlines()[-1]}") from error
    return _node(state.nodes, state.nodes[0])


def _node(nodes: Any, source: Any) -> Node:
    props, kind = source.props, str(source.type).rsplit(".", 1)[-1]
    if kind not in TAGS:
        raise UnsupportedError(f"a scene file has no element for '{props.plugin_name()}' ({kind})")
    found = Node(TAGS[kind], props.plugin_name(), props.id())
    for name in props.keys():
        found.entries[name] = _value(nodes, name, props[name])
    return found


def _value(nodes: Any, name: str, value: Any) -> Any:
    """The same without types of Mitsuba."""
    if isinstance(value, mi.Properties.ResolvedReference):
        return _node(nodes, nodes[value.index()])
    if isinstance(value, mi.Properties.Reference):
        return Reference(value.id())
    if isinstance(value, (bool, int, float, str)):
        return value
    kind = type(value).__name__
    if "Transform4" in kind:
        return np.array(value.matrix, dtype=np.float64)
    if "Color3" in kind:
        return Colour(tuple(map(float, value)))
    if kind == "Spectrum":
        return Spectrum(tuple(value.values), () if value.is_uniform() else tuple(value.wavelengths))
    if kind.startswith("Array3"):
        return Vector(tuple(map(float, value)))
    raise UnsupportedError(f"a scene file has no element for '{name}', a {kind}")


def to_xml(scene: Node, comment: str) -> str:
    """The file, with a `comment` at its head."""
    lines = ['<?xml version="1.0" encoding="utf-8"?>', f"<!-- {comment.replace('--', '- -')} -->",
             f'<scene version="{mi.__version__}">']  # fmt: skip
    for name, value in scene.entries.items():
        lines += _lines(name, value, INDENT)
    return "\n".join([*lines, "</scene>", ""])


def _lines(name: str, value: Any, indent: str) -> list[str]:
    named = "" if name.startswith(UNNAMED) else f" name={quoteattr(name)}"
    if isinstance(value, Node):
        own = f" id={quoteattr(value.id)}" if value.id else ""
        head = f"{indent}<{value.tag} type={quoteattr(value.plugin)}{own}{named}"
        if not value.entries:
            return [head + "/>"]
        inner = [line for key, entry in value.entries.items() for line in _lines(key, entry, indent + INDENT)]
        return [head + ">", *inner, f"{indent}</{value.tag}>"]
    if isinstance(value, np.ndarray):
        matrix = f"{indent}{INDENT}<matrix value={quoteattr(_numbers(value.ravel()))}/>"
        return [f"{indent}<transform{named}>", matrix, f"{indent}</transform>"]
    return [f"{indent}<{_leaf(value, named)}/>"]


def _leaf(value: Any, named: str) -> str:
    """Element and attributes of what has no children."""
    if isinstance(value, Reference):
        return f"ref id={quoteattr(value.id)}{named}"
    if isinstance(value, Vector):
        x, y, z = map(_number, value.xyz)
        return f'point{named} x="{x}" y="{y}" z="{z}"'
    if isinstance(value, bool):
        return f'boolean{named} value="{str(value).lower()}"'
    if isinstance(value, str):
        return f"string{named} value={quoteattr(value)}"
    if isinstance(value, Colour):
        return f'rgb{named} value="{_numbers(value.rgb)}"'
    if isinstance(value, Spectrum):
        pairs = zip(value.wavelengths, value.values, strict=True)
        text = ", ".join(f"{_number(w)}:{_number(v)}" for w, v in pairs) if value.wavelengths else (
            _number(value.values[0]))  # fmt: skip
        return f'spectrum{named} value="{text}"'
    return f'{"integer" if isinstance(value, int) else "float"}{named} value="{_number(value)}"'


def _numbers(values: Any) -> str:
    return ", ".join(map(_number, values))


def _number(value: Any) -> str:
    """The shortest text that is read as the very same number."""
    return repr(int(value)) if isinstance(value, int) else repr(float(value))
