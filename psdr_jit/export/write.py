"""Writing a scene as it is now into a file that Mitsuba loads, and reading it again to see that it is the same one."""

from __future__ import annotations

import gc
import os
import tempfile
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.cluster.source import SceneFile
from psdr_jit.cluster.values import to_numpy
from psdr_jit.core import files
from psdr_jit.core.threads import one_at_a_time
from psdr_jit.errors import OptionError, SceneError, UnsupportedError
from psdr_jit.export.assets import Assets
from psdr_jit.export.owners import owners
from psdr_jit.export.put import put, with_twins
from psdr_jit.export.tree import Node, read, to_xml
from psdr_jit.scene.guard import require_scene
from psdr_jit.scene.io import load_scene
from psdr_jit.scene.names import traverse
from psdr_jit.scene.params import is_transform, parameter_value

#: Relative to the largest number of a parameter: what reading a file may round, such as lengths of normals.
ROUNDING = 1e-6

#: What names of our plugins begin with.
OURS = "psdr_"

#: Folder of meshes and pictures beside the file: its name without suffix, and this.
BESIDE = "_files"


@one_at_a_time
def write_scene(scene: mi.Scene, path: str | os.PathLike, source: SceneFile | str) -> Path:
    """Write `scene` as it is now to the file `path`, with meshes and pictures in a folder beside; returns the path.

    `source`: the file that the scene was loaded from, a `SceneFile` if with other than its own defaults. Integrator,
    sensors and whatever has not changed stay as they are there, with `$defaults` and includes resolved. Numbers keep
    all their digits. `mi.load_file` reads the result, after `import psdr_jit` if plugins of ours are in it.

    The file is read again before it takes its place. Raises `UnsupportedError` with the name of the parameter for what
    a scene file cannot say, `SceneError` if `source` is another scene, `StorageError` if the disk does not take it.
    """
    require_scene(scene)
    source = SceneFile(os.fspath(source)) if isinstance(source, (str, os.PathLike)) else source
    path = Path(path)
    if path.suffix != ".xml":
        raise OptionError(f"'{path}': give the scene file a name that ends in .xml")
    if os.path.abspath(path) == source.path:
        raise OptionError(f"'{path}' is the file that the scene was loaded from: choose another name")
    assets = Assets(path.stem + BESIDE, Path(source.path).parent)
    tree = _as_now(scene, source, assets)
    assets.copy_rest(tree)
    text = to_xml(tree, _comment(tree, source))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".psdr-") as staging:
            written = _staged(Path(staging, path.name), text, assets)
            _require_same(scene, written, path)
            _moved(written, path, assets)
    except OSError as error:
        raise files.refusal(path, error) from error
    return path


def _as_now(scene: mi.Scene, source: SceneFile, assets: Assets) -> Node:
    """The tree of the source with all values that differ from it."""
    tree = read(source.path, **source.defaults)
    params, changed = traverse(scene), _different(scene, _values(load_scene(source.path, **source.defaults)))
    gc.collect()  # Dr.Jit's virtual calls reach every scene that is alive
    found = owners(scene, tree)
    for name in with_twins(changed, params):
        node = params.properties[name][2]
        put(found.get(node), node, name, parameter_value(params, name), assets)
    return tree


def _values(scene: mi.Scene) -> dict[str, Any]:
    """Numbers by parameter; poses as matrices, in double precision where they are."""
    params = traverse(scene)
    return {name: _plain(parameter_value(params, name)) for name in params.keys()}


def _plain(value: Any) -> Any:
    if dr.is_array_v(value) or is_transform(value):
        found = to_numpy(value)
        return np.array(value.matrix if is_transform(value) else value) if found is None else found
    return value


def _different(scene: mi.Scene, other: dict[str, Any], rounding: float = 0.0) -> list[str]:
    """Parameters of `scene` that are not as in `other`. Raises `SceneError` if it has others."""
    own = _values(scene)
    odd = sorted(own.keys() ^ other.keys())
    if odd:
        raise SceneError(f"the scene is not the one in the file: only one of them has '{odd[0]}'; name the file and "
                         "the defaults that it was loaded with, with optimize=False")  # fmt: skip
    return [name for name, value in own.items() if not _equal(value, other[name], rounding)]


def _equal(one: Any, other: Any, rounding: float) -> bool:
    if not isinstance(one, np.ndarray) or not isinstance(other, np.ndarray):
        return type(one) is type(other) and (one == other or one != one and other != other)
    if one.shape != other.shape:
        return False
    if rounding == 0 or not np.issubdtype(one.dtype, np.floating):
        return np.array_equal(one, other, equal_nan=np.issubdtype(one.dtype, np.floating))
    return np.allclose(one, other, rtol=0, atol=rounding * np.max(np.abs(one), initial=0.0), equal_nan=True)


def _staged(path: Path, text: str, assets: Assets) -> Path:
    if assets.contents:
        (path.parent / assets.folder).mkdir()
    for name, content in assets.contents.items():
        files.write_bytes(path.parent / assets.folder / name, content)
    return files.write_bytes(path, text.encode())


def _require_same(scene: mi.Scene, written: Path, path: Path) -> None:
    """Raise `UnsupportedError` unless the file holds the same scene, up to rounding."""
    try:
        again = _values(load_scene(written))
    except SceneError as error:
        said = str(error).replace(str(written), str(path))
        raise UnsupportedError(f"the scene cannot be written to a file: {said}") from error
    gc.collect()
    try:
        off = _different(scene, again, ROUNDING)
    except SceneError as error:
        raise UnsupportedError(f"the scene cannot be written to a file, which would be another one: {error}") from error
    if off:
        raise UnsupportedError(
            f"parameter '{off[0]}' cannot be written to a scene file: it has another value when that is read again; "
            "values of all parameters of a run are in its final.npz, or save them with NumPy"
        )


def _moved(written: Path, path: Path, assets: Assets) -> None:
    """Put all in place; the scene file last, so that none is there whose files are those of another."""
    path.unlink(missing_ok=True)
    beside = path.parent / assets.folder
    if assets.contents:
        beside.mkdir(exist_ok=True)
    for name in assets.contents:
        os.replace(written.parent / assets.folder / name, beside / name)
    os.replace(written, path)


def _comment(tree: Node, source: SceneFile) -> str:
    ours = sorted({node.plugin for node in tree.walk() if node.plugin.startswith(OURS)})
    said = f"; import psdr_jit before it is loaded: it brings {', '.join(ours)}" if ours else ""
    return f"written by psdr_jit from {Path(source.path).name}{said}"
