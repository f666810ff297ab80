"""What lies beside a scene file: meshes, pictures and grids of which parameters changed, copies of the others."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from psdr_jit.errors import SceneError
from psdr_jit.export.tree import Node

#: Property by which objects name their file.
FILE = "filename"


@dataclass
class Assets:
    """Files by name, below the `folder` that the scene file calls them by. `origin`: folder of the file it was made of.
    """

    folder: str
    origin: Path
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, name: str, content: bytes) -> str:
        """Keep a file under a name like this one; what the scene file has to call it."""
        return f"{self.folder}/{add_file(self.contents, name, content)}"

    def source_of(self, node: Node) -> Path:
        """The file that an object was read from. Raises `SceneError` if it is gone."""
        named = node.entries[FILE]
        below = self.origin / named
        path = below if below.is_file() else Path(str(mi.file_resolver().resolve(named)))
        if not path.is_file():
            raise SceneError(f"'{named}', which the scene was loaded from, is not there any more: put it back")
        return path

    def copy_rest(self, tree: Node) -> None:
        """Copies of the files that are named and not among those added."""
        for node in tree.walk():
            named = node.entries.get(FILE)
            if isinstance(named, str) and not named.startswith(f"{self.folder}/"):
                path = self.source_of(node)
                node.entries[FILE] = self.add(path.name, path.read_bytes())


def add_file(contents: dict[str, bytes], name: str, content: bytes) -> str:
    """Keep `content` among other files, under a name like this one that every system takes; the name."""
    stem, point, ending = name.rpartition(".")
    suffix = point + ending
    stem = re.sub(r"[^\w.-]+", "_", stem).strip("_.") or "file"
    name, count = stem + suffix, 1
    while contents.get(name, content) != content:
        name, count = f"{stem}_{count}{suffix}", count + 1
    contents[name] = content
    return name


def mesh(shape: mi.Mesh) -> bytes:
    """A binary PLY file."""
    stream = mi.MemoryStream()  # not a file: Mitsuba does not notice when the last of it is lost
    shape.write_ply(stream)
    return stream.raw_buffer()


def picture(values: np.ndarray) -> bytes:
    """An EXR file of single precision, of (H, W, C) values."""
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return stream.raw_buffer()


def grid(values: np.ndarray) -> bytes:
    """Mitsuba's format of (Z, Y, X, C) values."""
    stream = mi.MemoryStream()
    mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32)).write(stream)
    return stream.raw_buffer()


def control_points(before: str, values: np.ndarray) -> bytes:
    """A file of curves: the text that they were read from with other numbers (N, 4); empty lines part curves."""
    rows = iter(values)
    lines = [" ".join(map(repr, map(float, next(rows)))) if line.strip() else "" for line in before.splitlines()]
    return ("\n".join(lines) + "\n").encode()
