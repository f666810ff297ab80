"""Where a scene comes from: what a worker needs to have the same one."""

from __future__ import annotations

import hashlib
import os
import re
import socket
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from psdr_jit.errors import OptionError, SceneError
from psdr_jit.scene.io import files_named, load_scene

INCLUDE = re.compile(r'<include\s+filename\s*=\s*"([^"]+)"')


@dataclass(frozen=True)
class SceneFile:
    """A scene file and the <default> values that it was loaded with.

    `send`: the file, and what it names (meshes, textures, includes) in its folder or below, travel to the workers.
    Otherwise every worker reads the file itself, under the same path; one whose file has other contents refuses.
    """

    path: str
    defaults: dict[str, Any] = field(default_factory=dict)
    send: bool = False

    def __post_init__(self) -> None:
        if not Path(self.path).is_file():
            raise SceneError(f"scene file '{self.path}' does not exist: check the path")
        object.__setattr__(self, "path", os.path.abspath(self.path))


@dataclass(frozen=True)
class Parcel:
    """A `SceneFile` on its way; made where the file is, opened where it is needed."""

    path: str
    defaults: tuple[tuple[str, str], ...]
    digest: str  # of the contents of the file, of those that it names, and of `defaults`
    files: dict[str, bytes] = field(default_factory=dict, repr=False)  # by path below the folder, if they travel

    def load(self) -> Any:
        """The scene. Raises `SceneError` where the file is missing, or has other contents."""
        if not self.files:
            if not Path(self.path).is_file():
                raise SceneError(
                    f"scene file '{self.path}' does not exist there: share the folder under the same path, or let the "
                    "file travel with SceneFile(..., send=True) (--send on the command line)"
                )
            if _digest(Path(self.path), self.defaults) != self.digest:
                raise SceneError(
                    f"scene file '{self.path}', or one that it names, has other contents there: bring it up to date, "
                    "or let it travel with SceneFile(..., send=True) (--send on the command line)"
                )
            return load_scene(self.path, **dict(self.defaults))
        with tempfile.TemporaryDirectory(prefix="psdr-scene-") as folder:
            for name, content in self.files.items():
                place = Path(folder, name)
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)
            return load_scene(Path(folder, Path(self.path).name), **dict(self.defaults))


def parcel_of(source: SceneFile) -> Parcel:
    """What travels. Raises `OptionError` for files outside of the scene's folder, if they are to."""
    path, defaults = Path(source.path), tuple(sorted((k, str(v)) for k, v in source.defaults.items()))
    files = {}
    for found in _files_of(path, defaults) if source.send else []:
        if not found.is_relative_to(path.parent):
            raise OptionError(
                f"'{found}', which the scene names, is not below its folder and cannot travel: move it there, or share "
                "the folder with the workers"
            )
        files[str(found.relative_to(path.parent))] = found.read_bytes()
    return Parcel(source.path, defaults, _digest(path, defaults), files)


def _files_of(path: Path, defaults: tuple[tuple[str, str], ...]) -> list[Path]:
    """The file, its includes, and what they name, as far as these are there."""
    found, left = [], [path]
    while left:
        file = left.pop()
        if file in found or not file.is_file():
            continue
        found.append(file)
        names = INCLUDE.findall(file.read_text(encoding="utf-8", errors="replace"))
        left += [Path(os.path.normpath(path.parent / name)) for name in names]
    try:
        named = files_named(path, **dict(defaults)) if path.is_file() else []
    except (RuntimeError, UnicodeDecodeError) as error:
        raise SceneError(f"scene file '{path}' cannot be read: {str(error).splitlines()[-1]}") from error
    files = [Path(os.path.normpath(path.parent / name)) for name in named]
    return sorted({*found, *(file for file in files if file.is_file())})


def _digest(path: Path, defaults: tuple[tuple[str, str], ...]) -> str:
    digest = hashlib.sha256(repr(defaults).encode())
    for file in _files_of(path, defaults):
        digest.update(file.name.encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def here() -> str:
    """The machine, for messages."""
    return socket.gethostname()
