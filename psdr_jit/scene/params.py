"""What can be differentiated in a scene: every scene parameter with a verdict and its reason."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from psdr_jit.core.compat import VERTEX_NORMALS, VERTEX_POSITIONS
from psdr_jit.errors import ParameterError, SceneError
from psdr_jit.scene.capabilities import COPIES, INSTANCING, TWINS
from psdr_jit.scene.names import plugin_name, stable_name, traverse


@dataclass(frozen=True)
class ParamInfo:
    """One scene parameter. `reason` says why it is not differentiable, or what to know when it is."""

    name: str                # the key in `psdr_jit.traverse(scene)`; Mitsuba's own where the object has an id
    kind: str                # geometry, material, texture, emitter, camera, film, medium or other
    type: str                # name of the value's type
    shape: tuple[int, ...]   # (4, 4) for transforms, () for plain Python numbers
    differentiable: bool
    reason: str = ""


#: Why a shape may have lost its name.
MERGED = "Mitsuba merges shapes: they keep their names if the scene is loaded with optimize=False"


def differentiable_params(scene: Any, params: Any = None) -> list[ParamInfo]:
    """Describe every parameter of `scene`, in traversal order.

    The verdict follows from the value's type. Mitsuba's own `NonDifferentiable` flag is not consulted: camera
    and lamp poses carry it although they are ordinary attached transforms.
    """
    params = _traversed(scene) if params is None else params
    return [_describe(params, name) for name in params.keys()]


def find_param(scene: Any, name: str, params: Any = None) -> ParamInfo:
    """The description of parameter `name`; raises `ParameterError` when unknown or not differentiable.

    `name`: any of those in `scene_names`. `params`: what `scene_names.traverse` returned for the scene, if at hand.
    """
    params = _traversed(scene) if params is None else params
    if not isinstance(name, str):
        raise ParameterError(f"a parameter is given by its name, such as 'shape.to_world', got {name!r}")
    if name not in params:
        name = stable_name(scene, name)
    if name not in params:
        known = [found.name for found in differentiable_params(scene, params) if found.differentiable]
        raise ParameterError(f"the scene has no parameter '{name}'{_suggestion(name, known or list(params.keys()))}")
    info = _describe(params, name)
    if not info.differentiable:
        raise ParameterError(f"parameter '{name}' cannot be differentiated: {info.reason}. "
                             "'psdr params SCENE.xml' lists those that can")
    return info


@contextmanager
def also_enabled(scene: Any, names: Sequence[str]) -> Iterator[None]:
    """With gradients of these parameters enabled; afterwards the scene is as it was. Raises `ParameterError`."""
    if not names:
        yield
        return
    params = _traversed(scene)
    found = [find_param(scene, name, params).name for name in names]
    before = {}
    for name in found:
        before |= values_to_keep(params, name)
    try:
        for name in found:
            _assign(params, name, _attached(before[name]))
        params.update()
        yield
    finally:
        for name, value in before.items():
            _assign(params, name, type(value)(value))
        params.update()


def values_to_keep(params: Any, name: str) -> dict[str, Any]:
    """Copies of the parameter and of what Mitsuba recomputes from it; still attached where they are."""
    kept = {name: type(params[name])(params[name])}  # not the value itself, which Mitsuba writes into
    if name.endswith(VERTEX_POSITIONS):
        normals = name[: -len(VERTEX_POSITIONS)] + VERTEX_NORMALS
        if normals in params and dr.width(params[normals]) > 0:
            kept[normals] = type(params[normals])(params[normals])
    return kept


def _assign(params: Any, name: str, value: Any) -> None:
    params[name] = value
    params.set_dirty(name)


def _attached(value: Any) -> Any:
    """An attached copy."""
    if is_transform(value):
        offset = dr.zeros(mi.Vector3f)
        dr.enable_grad(offset)
        return type(value)().translate(offset) @ value
    copy = type(value)(dr.detach(value))
    dr.enable_grad(copy)
    return copy


def _traversed(scene: Any) -> Any:
    if not isinstance(scene, mi.Object):
        raise SceneError(f"expected a Mitsuba scene of variant '{mi.variant()}', got {type(scene).__name__}: "
                         "load one with mi.load_file")
    return traverse(scene)


def parameter_value(params: Any, name: str) -> Any:
    """`params[name]`, which fails where a parameter is unset (None), as in the BSDF `hair`."""
    value, kind, node, _ = params.properties[name]
    return None if (value if kind is None else params.get_property(value, kind, node)) is None else params[name]


def _is_no_place(name: str) -> bool:
    return not name.endswith(("positions", "to_world"))


def _suggestion(name: str, known: list[str]) -> str:
    last = name.rsplit(".", 1)[-1]
    own = [k for k in known if k.startswith(f"{name}.")]
    if own:  # an object was named, most likely to be moved
        own.sort(key=_is_no_place)
        return "; of that object there are " + ", ".join(f"'{k}'" for k in own)
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if "." not in name:  # an object again, misspelt
        objects = difflib.get_close_matches(name, {k.rsplit(".", 1)[0] for k in known}, n=1)
        of_it = [k for k in known if objects and k.startswith(f"{objects[0]}.")]
        close = sorted(of_it, key=_is_no_place) or close
    close += [k for k in known if k.rsplit(".", 1)[-1] == last and k not in close]
    if not close:
        return f"; 'psdr params SCENE.xml' lists them ({MERGED})"
    owner = name.rsplit(".", 1)[0]
    unknown = not any(k.startswith(f"{owner}.") for k in known)
    nameless = any(k.startswith("shape") and k.endswith(VERTEX_POSITIONS) for k in known)
    hint = f" ({MERGED})" if unknown and nameless else ""
    return "; did you mean " + ", ".join(f"'{k}'" for k in close[:3]) + "?" + hint


def _describe(params: Any, name: str) -> ParamInfo:
    value = parameter_value(params, name)
    reason = _obstacle(name, value) or _rests(params, name)
    twin = TWINS.get((plugin_name(params.properties[name][2]), name.rsplit(".", 1)[-1]))
    if reason and twin:
        reason += f"; '{twin}' is the same material without this limit"
    differentiable = not reason
    if differentiable and name.endswith("vertex_normals"):
        reason = "shading normals; Mitsuba recomputes them whenever vertex_positions change"
    kind, type_name = _kind(params, name, value), type(value).__name__
    return ParamInfo(name, kind, type_name, _shape(value), differentiable, reason)


def is_transform(value: Any) -> bool:
    return "Transform" in type(value).__name__


def _shape(value: Any) -> tuple[int, ...]:
    if is_transform(value):
        n = int(type(value).__name__[-2])
        return (n, n)
    if value is None or not dr.is_array_v(value):
        return ()
    shape = tuple(dr.shape(value))
    # a JIT vector has a trailing lane dimension, which is 1 for a uniform parameter
    return shape[:-1] if len(shape) > 1 and shape[-1] == 1 and not dr.is_tensor_v(value) else shape


def _obstacle(name: str, value: Any) -> str:
    """Why a value of this type carries no derivative; empty when it does."""
    kind = type(value).__name__
    if value is None:
        return "it is not set: this object works without it"
    if isinstance(value, (bool, int, float)):
        return f"Mitsuba stores it as a plain Python {kind}, which Dr.Jit does not track"
    if ".film." in f".{name}":
        return "the film's size and crop define the pixel grid, they are whole numbers of pixels"
    if kind.startswith("Scalar"):
        return f"it is a host-side constant ({kind})"
    if is_transform(value):
        return "" if dr.is_diff_v(value.matrix) else f"variant '{mi.variant()}' does not track derivatives"
    if not dr.is_array_v(value):
        return f"a value of type {kind} carries no derivative"
    if not dr.is_float_v(value):
        if name.endswith(".data"):
            return (f"the texture is stored in whole numbers ({kind}): load it as numbers that have derivatives, by "
                    '<string name="format" value="variant"/> in the bitmap')
        return f"it holds whole numbers ({kind}), for example face indices"
    if dr.width(value) == 0 or 0 in dr.shape(value):
        return "it is an empty buffer: this shape does not have it"
    return "" if dr.is_diff_v(value) else f"variant '{mi.variant()}' does not track derivatives"


def _rests(params: Any, name: str) -> str:
    """Why the place of an instance, or of what it shows, is not differentiated; empty if it is something else."""
    node = params.properties[name][2]
    if not isinstance(node, mi.Shape) or not name.endswith(("to_world", VERTEX_POSITIONS)):
        return ""
    owners = (node, params.hierarchy[node][0])
    instanced = any(owner is not None and plugin_name(owner) in INSTANCING for owner in owners)
    return f"what is instanced rests; {COPIES}" if instanced else ""


def _kind(params: Any, name: str, value: Any) -> str:
    """The nearest owner that says what the parameter is about, found by walking up the scene graph."""
    owners = ((mi.Film, "film"), (mi.Sensor, "camera"), (mi.Emitter, "emitter"), (mi.BSDF, "material"),
              (mi.Medium, "medium"), (mi.Shape, "geometry"))
    node = params.properties[name][2]
    while node is not None:
        for cls, kind in owners:
            if isinstance(node, cls):
                textured = kind == "material" and value is not None and dr.is_tensor_v(value)
                return "texture" if textured else kind
        node = params.hierarchy[node][0]
    return "other"
