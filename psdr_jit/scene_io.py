"""Loading scene files with errors that name the cause, and what a scene file says about its integrator."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path
from typing import Any

import mitsuba as mi

from psdr_jit.errors import OptionError, SceneError, SetupError

DEFAULT_VARIANT = "llvm_ad_rgb"


def use_variant(name: str) -> None:
    """Make `name` the active Mitsuba variant; the plugins of psdr_jit follow by themselves."""
    if name not in mi.variants():
        raise OptionError(f"this Mitsuba has no variant '{name}'; it has {', '.join(mi.variants())}")
    try:
        mi.set_variant(name)
    except (ImportError, RuntimeError) as error:
        if (getattr(error, "name", None) or "").startswith("psdr_jit"):
            raise   # a module of ours is missing: a defect, not a matter of set-up
        raise SetupError(f"variant '{name}' does not start: {error}. "
                         "'psdr doctor' says what is missing") from error


def load_scene(path: str | os.PathLike, **defaults: Any) -> Any:
    """Load a scene file with its shapes kept apart, so that their parameters keep their names.

    `defaults` override the file's `<default>` values. What Mitsuba cannot read becomes a `SceneError`.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"scene file '{path}' does not exist: check the path")
    if not os.access(path, os.R_OK):
        raise SceneError(f"scene file '{path}' cannot be read: check its permissions")
    try:
        scene = mi.load_file(os.fspath(path), optimize=False, **{k: str(v) for k, v in defaults.items()})
    except (RuntimeError, UnicodeDecodeError) as error:
        text = " ".join(str(error).split())
        meshes = _mesh_files(path, defaults) if "shape plugin" in text else []
        if meshes and not any(mesh in text for mesh in meshes):
            text += f" Is one of its mesh files empty or corrupt: {', '.join(meshes)}?"
        raise SceneError(f"scene file '{path}' cannot be loaded: {text}") from error
    if not isinstance(scene, mi.Scene):
        raise SceneError(f"scene file '{path}' holds a {type(scene).__name__}, not a scene: "
                         "its root element must be <scene>")
    if not scene.sensors():
        raise SceneError(f"scene file '{path}' has no <sensor>: there is no image to render")
    return scene


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
        raise SceneError(f"the package has no scene '{name}': the installation is incomplete")
    return path


def check_sensor(scene: Any, index: int) -> None:
    """Raise `OptionError` unless the scene has a sensor with this index."""
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise OptionError(f"there is no sensor {index}: the scene has {count} (0 to {count - 1})")


def _nodes(path: str | os.PathLike, defaults: dict[str, Any]) -> Any:
    """The parsed, not yet instantiated, objects of a scene file, with $defaults and includes resolved."""
    config = mi.parser.ParserConfig(mi.variant())
    return mi.parser.parse_file(config, os.fspath(path), **{k: str(v) for k, v in defaults.items()}).nodes


def _mesh_files(path: Path, defaults: dict[str, Any]) -> list[str]:
    """Names of the files that the scene's shapes are read from."""
    shapes = [n.props for n in _nodes(path, defaults) if n.type == mi.ObjectType.Shape]
    return [str(props["filename"]) for props in shapes if "filename" in props.keys()]
