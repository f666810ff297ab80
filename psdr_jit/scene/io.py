"""Loading scene files with errors that name the cause, and what a scene file says about its integrator."""

from __future__ import annotations

import difflib
import os
import re
from importlib import resources
from numbers import Integral
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from psdr_jit.errors import OptionError, PsdrError, SceneError, SetupError
from psdr_jit.scene.curve_ends import pad_curves
from psdr_jit.scene.guard import require_scene, require_variant

DEFAULT_VARIANT = "llvm_ad_rgb"
UNUSED = re.compile(r"Found unused parameters: - \$([\w.-]+)=")  # how Mitsuba says that a file has no such <default>
DEFAULT = re.compile(r'<default\s+name\s*=\s*"([^"]+)"')

LISTED = 5  # mesh files in an error, at most
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip

PLY_INDEX_NAMES = ("vertex_index", "vertex_indices")


def use_variant(name: str) -> None:
    """Make `name` the active Mitsuba variant; the plugins of psdr_jit follow by themselves."""
    if name not in mi.variants():
        raise OptionError(f"this Mitsuba has no variant '{name}'; it has {', '.join(mi.variants())}")
    try:
        mi.set_variant(name)
    except PsdrError:
        raise           # says what to do
    except (ImportError, RuntimeError) as error:
        if (getattr(error, "name", None) or "").startswith("psdr_jit"):
            raise   # a module of ours is missing: a defect, not a matter of set-up
        raise SetupError(f"variant '{name}' does not start: {str(error).rstrip('. ')}. "
                         "'psdr doctor' says what is missing") from error


def load_scene(path: str | os.PathLike, **defaults: Any) -> Any:
    """Load a scene file with its shapes kept apart, so that their parameters keep their names.

    `defaults` override the file's `<default>` values. What Mitsuba cannot read becomes a `SceneError`.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"'{path}' is a folder: give one of the scene files in it")
    if not path.is_file():
        raise SceneError(f"scene file '{path}' does not exist: check the path")
    if not os.access(path, os.R_OK):
        raise SceneError(f"scene file '{path}' cannot be read: check its permissions")
    meshes = _check_mesh_files(path, defaults)
    try:
        scene = mi.load_file(os.fspath(path), optimize=False, **{k: str(v) for k, v in defaults.items()})
    except (RuntimeError, UnicodeDecodeError) as error:
        text = _cause(error)
        if unused := UNUSED.findall(text):
            raise SceneError(f"scene file '{path}' has no <default name=\"{unused[0]}\"> to set; {_defaults(path)}"
                             ) from error  # fmt: skip
        by_mesh = not text or "shape plugin" in text or isinstance(error, UnicodeDecodeError)
        if by_mesh and meshes and not any(mesh in text for mesh in meshes):
            fault = "missing" if "file not found" in text else "empty or corrupt"
            text = f"{text.rstrip('. ')}. Is one of its mesh files {fault}: {_suspects(meshes, text)}?"
        raise SceneError(f"scene file '{path}' cannot be loaded: {text}") from error
    if not isinstance(scene, mi.Scene):
        raise SceneError(f"scene file '{path}' holds a {type(scene).__name__}, not a scene: "
                         "its root element must be <scene>")
    if not scene.sensors():
        raise SceneError(f"scene file '{path}' has no <sensor>: there is no image to render")
    pad_curves(scene)
    return scene


def _suspects(meshes: list[str], text: str) -> str:
    """Those of the mesh files that Mitsuba's error names, as it does, without their folder; else the first of all."""
    named = [mesh for mesh in meshes if f'"{Path(mesh).name}"' in text] or meshes
    more = f" and {len(named) - LISTED} others" if len(named) > LISTED else ""
    return ", ".join(named[:LISTED]) + more


def _defaults(path: Path) -> str:
    """What the file lets one set."""
    names = DEFAULT.findall(path.read_text(encoding="utf-8", errors="replace"))
    return f"it has {', '.join(map(repr, names))}" if names else "it has none at all"


def _cause(error: Exception) -> str:
    """What Mitsuba says, without its source lines; what one of our plugins says, without Python's traceback."""
    own = re.findall(r"\b(?:Parameter|Option|Scene|Unsupported)Error: (.*)", str(error))
    text = own[-1] if own else " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\]", "", str(error)).split())
    if "include recursion depth" in text:
        files = re.findall(r"Error while loading (.*?) \(line", text)
        around = files[: files.index(files[0], 1) + 1] if files[0] in files[1:] else files
        return f"its <include>s do not end ({' includes '.join(around)}); remove one of them"
    return text


def integrator_properties(path: str | os.PathLike, **defaults: Any) -> dict[str, Any]:
    """Plugin name (`type`) and plain properties of the file's integrator; empty when it has none."""
    for node in _nodes(path, defaults):
        if node.type == mi.ObjectType.Integrator:
            plain = {k: node.props[k] for k in node.props.keys()}
            plain = {k: v for k, v in plain.items() if isinstance(v, (bool, int, float, str))}
            return {"type": node.props.plugin_name(), **plain}
    return {}


def shipped_scene(name: str) -> Path:
    """Path of a scene file that is installed with the package, such as `cbox.xml`."""
    path = Path(str(resources.files("psdr_jit.scenes") / name))
    if not path.is_file():
        there = sorted(str(file.relative_to(path.parent)) for file in path.parent.glob("*.xml"))
        near = difflib.get_close_matches(path.name, there)
        listed = ", ".join(there) or "none: install it anew"
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {listed}"
        raise SceneError(f"the package has no scene '{name}'; {hint}")
    return path


def check_sensor(scene: Any, index: int) -> None:
    """Raise `OptionError` unless the scene has a sensor with this index."""
    find_sensor(scene, index)


def find_sensor(scene: Any, sensor: Any) -> Any:
    """The sensor itself, or the one with this index; a typed error if there is none."""
    require_scene(scene)
    require_variant(sensor, "the sensor")
    if isinstance(sensor, mi.Sensor):
        return sensor
    count = len(scene.sensors())
    if count == 0:
        raise SceneError("the scene has no sensor: there is no image to differentiate; add a <sensor>")
    if isinstance(sensor, bool) or not isinstance(sensor, Integral):
        raise OptionError(f"sensor = {sensor!r}: expected an index from 0 to {count - 1}, or a Mitsuba sensor")
    if not 0 <= sensor < count:
        raise OptionError(f"there is no sensor {sensor}: the scene has {count} (0 to {count - 1})")
    return scene.sensors()[int(sensor)]


def _nodes(path: str | os.PathLike, defaults: dict[str, Any]) -> Any:
    """The parsed, not yet instantiated, objects of a scene file, with $defaults and includes resolved."""
    config = mi.parser.ParserConfig(mi.variant())
    return mi.parser.parse_file(config, os.fspath(path), **{k: str(v) for k, v in defaults.items()}).nodes


def files_named(path: str | os.PathLike, **defaults: Any) -> list[str]:
    """Names of the files that objects of a scene file are read from: meshes, textures, but not includes."""
    found = [node.props["filename"] for node in _nodes(path, defaults) if "filename" in node.props.keys()]
    return [str(name) for name in dict.fromkeys(found)]


def _mesh_files(path: Path, defaults: dict[str, Any]) -> list[str]:
    """Names of the files that the scene's shapes are read from."""
    shapes = [n.props for n in _nodes(path, defaults) if n.type == mi.ObjectType.Shape]
    return [str(props["filename"]) for props in shapes if "filename" in props.keys()]


def _check_mesh_files(path: Path, defaults: dict[str, Any]) -> list[str]:
    """Names of the scene's mesh files, empty if the scene file itself is corrupt.

    Refuses PLY files whose faces refer to vertices that are not there: reading them ends Mitsuba's process.
    """
    try:
        names = _mesh_files(path, defaults)
    except (RuntimeError, UnicodeDecodeError):
        return []       # Mitsuba says so when it loads the scene
    for file in [path.parent / name for name in names if name.lower().endswith(".ply")]:
        found = _largest_index(file) if file.is_file() else None
        if found is not None and found[0] >= found[1]:
            raise SceneError(f"scene file '{path}' cannot be loaded: mesh file '{file}' is corrupt: a face refers to "
                             f"vertex {found[0]}, but there are {found[1]}")
    return names


def _largest_index(path: Path) -> tuple[int, int] | None:
    """`(largest vertex index, number of vertices)` of a PLY file; None if it is none of triangles, or not understood.

    A negative index counts as unsigned, as in Mitsuba.
    """
    try:
        data = path.read_bytes()
        header, _, body = data.partition(b"end_header")
        encoding, elements = _ply_header(header.decode("ascii"))
        body = body[body.index(b"\n") + 1 :]
        index = _ascii_indices(body, elements) if encoding == "ascii" else _binary_indices(body, encoding, elements)
    except (OSError, ValueError, KeyError, IndexError):
        return None     # Mitsuba's reader knows better what is wrong
    return (int(index.astype(np.uint32).max()) if index.size else -1), elements["vertex"][0]


def _ply_header(header: str) -> tuple[str, dict[str, tuple[int, list[list[str]]]]]:
    """Encoding, and of each element its count and the words of its property lines."""
    encoding, elements, properties = "", {}, []
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["format"]:
            encoding = words[1]
        elif words[:1] == ["element"]:
            properties = []
            elements[words[1]] = (int(words[2]), properties)
        elif words[:1] == ["property"]:
            properties.append(words[1:])
    if list(elements)[:2] != ["vertex", "face"]:
        raise ValueError("another order of elements")
    return encoding, elements


def _ascii_indices(body: bytes, elements: dict[str, Any]) -> np.ndarray:
    skip, count = elements["vertex"][0], elements["face"][0]
    if elements["face"][1][0][-1] not in PLY_INDEX_NAMES:
        raise ValueError("faces start with something else")
    rows = [line.split()[1:4] for line in body.decode("ascii").splitlines()[skip : skip + count]]
    return np.array(rows, dtype=np.int64)


def _binary_indices(body: bytes, encoding: str, elements: dict[str, Any]) -> np.ndarray:
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    (vertices, vertex), (faces, face) = elements["vertex"], elements["face"]
    start = vertices * sum(np.dtype(PLY_TYPES[kind]).itemsize for kind, _ in vertex)
    fields = []
    for words in face:
        if words[0] != "list":
            fields.append((words[1], order + PLY_TYPES[words[0]]))
        elif words[3] in PLY_INDEX_NAMES:
            fields += [("corners", order + PLY_TYPES[words[1]]), ("index", order + PLY_TYPES[words[2]], 3)]
        else:
            raise ValueError("lists of other things")
    table = np.frombuffer(body, np.dtype(fields), faces, start)
    if np.any(table["corners"] != 3):
        raise ValueError("not all faces are triangles")
    return table["index"].astype(np.int64)
