"""Putting the value of a parameter into the tree of a scene file: what each kind of it is called there.

Most are called the same. Exceptions: poses replace the ways to say them (centre, radius, end points); an index of
refraction is a ratio of two; sizes of a film are two numbers; the horizontal angle of view; meshes, pictures, grids and
curves are files.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.cluster.values import to_numpy
from psdr_jit.core.compat import CONTROL_POINTS
from psdr_jit.errors import UnsupportedError
from psdr_jit.export import assets as files
from psdr_jit.export.assets import FILE, Assets
from psdr_jit.export.owners import Slot
from psdr_jit.export.tree import Colour, Node, Reference, Spectrum, Vector
from psdr_jit.scene.params import is_transform

#: Other ways to say where an object is, which `to_world` replaces.
PLACES = ("center", "radius", "p0", "p1", "position", "direction", "origin", "target", "up")

#: Meshes that a PLY file can stand for, with what it does not say.
MESHES = ("obj", "ply", "serialized", "cube", "mesh")
KEPT = ("face_normals", "flip_normals", "silhouette_sampling_weight")
PARTS = ("vertex_", "face_", "faces")

#: Materials whose index of refraction is given as a ratio.
DIELECTRICS = ("dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic", "psdr_dielectric",
               "psdr_plastic")  # fmt: skip

#: Of a film: what the file calls the two numbers of a parameter.
FILM = {"size": ("width", "height"), "crop_size": ("crop_width", "crop_height"),
        "crop_offset": ("crop_offset_x", "crop_offset_y")}  # fmt: skip

#: Index of refraction and absorption of a metal: the name of a material stands for both.
CONDUCTOR = ("eta", "k")


def with_twins(changed: list[str], known: Any) -> list[str]:
    """Parameters that have changed, and those that have to be written with them."""
    eta, k = (f".{key}.value" for key in CONDUCTOR)
    swaps = ((eta, k), (k, eta))
    twins = [name.removesuffix(one) + other for name in changed for one, other in swaps if name.endswith(one)]
    return list(dict.fromkeys([*changed, *(name for name in twins if name in known)]))


def put(place: Node | Slot | None, owner: Any, name: str, value: Any, assets: Assets) -> None:
    """Write `value` of the parameter `name` where its `owner` is in the file. Raises `UnsupportedError`."""
    last = name.rsplit(".", 1)[-1]
    if isinstance(place, Slot):
        if place.key in CONDUCTOR:
            place.node.drop("material")
        place.node.entries[place.key] = _colour(name, value, place)
    elif place is None:
        raise UnsupportedError(f"{_cannot(name)}: it belongs to an object that the scene file does not name; give it "
                               "one there, such as a <bsdf>")  # fmt: skip
    elif isinstance(owner, mi.Mesh) and last.startswith(PARTS):
        _mesh(place, owner, name, assets)
    elif (place.plugin, last) in FILES:
        FILES[place.plugin, last](place, name, value, assets)
    elif last == "to_world" or (last == "to_uv" and is_transform(value)):
        _pose(place, last, value)
    elif last == "position" and place.plugin == "point":
        place.drop("to_world")
        place.entries[last] = Vector(tuple(_flat(value)))
    elif last == "eta" and place.plugin in DIELECTRICS:
        place.entries |= {"int_ior": float(_flat(value)[0]), "ext_ior": 1.0}
    elif last == "x_fov":
        place.drop("focal_length")
        place.entries |= {"fov": float(_flat(value)[0]), "fov_axis": "x"}
    else:
        _same_name(place, name, last, value)


def _cannot(name: str) -> str:
    return f"parameter '{name}' has changed, and a scene file cannot say so"


def _require_colours(name: str) -> None:
    """Raises `UnsupportedError` where values are no colours that a file could hold."""
    if mi.is_spectral:
        raise UnsupportedError(f"{_cannot(name)}: spectral variants keep coefficients of colours; write it under an "
                               "rgb variant")  # fmt: skip


def _flat(value: Any) -> np.ndarray:
    """Its numbers, as the file has them."""
    found = to_numpy(value)
    return np.ravel(np.array(value, dtype=np.float64) if found is None else found.astype(np.float64))


def _colour(name: str, value: Any, place: Slot) -> Any:
    _require_colours(name)
    numbers = tuple(map(float, _flat(value)))
    if len(numbers) == 3:
        return Colour(numbers)
    if len(numbers) != 1:
        raise UnsupportedError(f"{_cannot(name)}: it has {len(numbers)} numbers where a colour is expected")
    return numbers[0] if isinstance(place.node.entries.get(place.key), float) else Spectrum(numbers)


def _same_name(place: Node, name: str, last: str, value: Any) -> None:
    """A number, a colour or a point that the file calls as the parameter is called. Loading tells if it does not."""
    if isinstance(value, (bool, int, float, str)):
        place.entries[last] = value
        return
    numbers = _flat(value) if not is_transform(value) else np.empty(0)
    if place.tag == "film" and last in FILM:
        place.entries |= {key: int(number) for key, number in zip(FILM[last], numbers, strict=True)}
        return
    before = place.entries.get(last)
    if isinstance(before, Vector) and numbers.size == 3:
        place.entries[last] = Vector(tuple(map(float, numbers)))
    elif numbers.size == 1 and not isinstance(before, (Node, Reference)):
        place.entries[last] = float(numbers[0])
    elif numbers.size == 3 and last == "value":  # a <texture> of one colour
        place.entries["color" if place.plugin == "srgb" else last] = Colour(tuple(map(float, numbers)))
    else:
        raise UnsupportedError(f"{_cannot(name)}: '{place.plugin}' has no such property")


def _pose(place: Node, last: str, value: Any) -> None:
    matrix = to_numpy(value).astype(np.float64)
    if matrix.shape == (3, 3):  # of texture coordinates: acts on u and v of a transform of space
        whole = np.eye(4)
        whole[:2, :2] = matrix[:2, :2]
        whole[:2, 3] = matrix[:2, 2]
        matrix = whole
    if last == "to_world":
        place.drop(*PLACES)
    place.entries[last] = matrix


def _mesh(place: Node, shape: mi.Mesh, name: str, assets: Assets) -> None:
    if place.entries.get(FILE, "").startswith(f"{assets.folder}/"):
        return  # by another of its parameters
    if place.plugin not in MESHES:
        raise UnsupportedError(f"{_cannot(name)}: of '{place.plugin}' a mesh file does not say everything")
    kept = {key: v for key, v in place.entries.items() if isinstance(v, (Node, Reference)) or key in KEPT}
    place.plugin = "ply"
    place.entries = {FILE: assets.add(f"{shape.id() or name.rpartition('.')[0]}.ply", files.mesh(shape)), **kept}


def _picture(place: Node, name: str, value: Any, assets: Assets) -> None:
    """A texture: its values as they are, linear."""
    _require_colours(name)
    values = np.array(dr.detach(value))
    place.entries |= {FILE: assets.add(f"{name}.exr", files.picture(values)), "raw": True}


def _environment(place: Node, name: str, value: Any, assets: Assets) -> None:
    """Mitsuba lets the last column stand once more before the first, and the first behind the last."""
    _require_colours(name)
    values = np.array(dr.detach(value))[:, 1:-1, :3]
    place.entries[FILE] = assets.add(f"{name}.exr", files.picture(values))


def _grid(place: Node, name: str, value: Any, assets: Assets) -> None:
    place.entries[FILE] = assets.add(f"{name}.vol", files.grid(np.array(dr.detach(value))))


def _curve(place: Node, name: str, value: Any, assets: Assets) -> None:
    before = assets.source_of(place).read_text(encoding="utf-8")
    values = np.array(dr.detach(value)).reshape(-1, 4)
    place.drop("to_world")
    place.entries[FILE] = assets.add(f"{name}.txt", files.control_points(before, values))


FILES = {
    ("bitmap", "data"): _picture,
    ("envmap", "data"): _environment,
    ("sdfgrid", "grid"): _grid,
    ("gridvolume", "data"): _grid,
    ("bsplinecurve", CONTROL_POINTS): _curve,
    ("linearcurve", CONTROL_POINTS): _curve,
}
"""Parameters that are files of their own: plugin and parameter -> what writes them."""
