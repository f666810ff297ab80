"""One scene parameter and one direction: the curve along which it is differentiated.

Forward mode (`Perturbation.attach`) and finite differences (`Perturbation.set_value`) walk along the same
curve theta -> value(theta), which is what makes them comparable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.compat import CONTROL_POINTS
from psdr_jit.core.upload import in_memory
from psdr_jit.errors import ParameterError
from psdr_jit.scene.guard import require_scene
from psdr_jit.scene.names import traverse
from psdr_jit.scene.params import ParamInfo, find_param, is_transform, values_to_keep


@dataclass(frozen=True)
class Perturbation:
    """A scene parameter and a curve through its present value; made by `perturb`.

    `curve(theta)` is the parameter's value at distance `theta` (a width-1 `mi.Float`, attached or not) along
    the direction, exact rather than linearised. `theta` is in units of the direction; radians for rotations.
    """

    scene: Any
    params: Any
    info: ParamInfo
    curve: Callable[[Any], Any]
    label: str              # the direction in words
    rotation: bool          # theta is an angle
    extent: float           # size of the shape that moves [scene units]; 0 when no shape moves
    scale: float            # magnitude of the direction (motion) or else of the parameter
    centre: tuple[float, ...] = ()
    originals: dict[str, Any] = field(default_factory=dict)
    how: dict[str, Any] = field(default_factory=dict)   # the arguments of `perturb` that it was made with

    @property
    def name(self) -> str:
        return self.info.name

    @property
    def moves(self) -> bool:
        """True when theta displaces something in space: its unit is then a length, or radians."""
        return bool(self.centre) or self.extent > 0

    def set_value(self, eps: float) -> None:
        """Put the scene at value(eps): detached, exact, with `params.update()` done."""
        self._write(dr.detach(self.curve(mi.Float(eps))))

    def attach(self, theta: Any = None) -> Any:
        """Put the scene at value(theta), attached, with the tangent 1 of `theta` already in the scene.

        Returns `theta`. Render with `render_forward` right after it: the call uses the tangent up.
        """
        theta = mi.Float(0) if theta is None else theta
        dr.enable_grad(theta)
        self._write(self.curve(theta))
        # A tangent set after params.update() would not reach what the scene derived from the parameter.
        dr.forward(theta, dr.ADFlag.ClearEdges)
        return theta

    def restore(self) -> None:
        """Put back the values found when the perturbation was made, detached."""
        for name, value in self.originals.items():
            self.params[name] = type(value)(value)
            self.params.set_dirty(name)
        self.params.update()

    def _write(self, value: Any) -> None:
        self.params[self.name] = in_memory(value)
        # equal values are skipped by params, but an attached one must replace a detached one
        self.params.set_dirty(self.name)
        self.params.update()


def perturb(scene: Any, name: str, direction: Any = None, *, rotate: Sequence[float] | None = None,
            index: int | None = None) -> Perturbation:
    """The curve of parameter `name` along one direction; exactly one way to give it, or none for numbers.

    - `direction=(dx, dy, dz)`: translation in world space, for `vertex_positions`, `control_points` (whose radii stay),
      `to_world` and points;
    - `rotate=(ax, ay, az)`: world axis (normalised here), theta in radians, about the centre of the shape's
      bounding box, or about its own origin for a sensor or a lamp;
    - `index=i`: one scalar of the parameter in flat order;
    - otherwise `direction` is one number, or as many as the parameter has scalars; default: all ones.

    Numbers come as sequences, NumPy or Dr.Jit arrays.
    """
    require_scene(scene)
    params = traverse(scene)
    info = find_param(scene, name, params)
    name = info.name
    if index is not None and (isinstance(index, bool) or not isinstance(index, Integral)):
        raise ParameterError(f"index must be a whole number, got {index!r}")
    if sum(x is not None for x in (direction, rotate, index)) > 1:
        raise ParameterError("give one of direction, rotate and index, not several")
    originals = {name: dr.detach(value) for name, value in values_to_keep(params, name).items()}
    base = originals[name]
    position = name.rsplit(".", 1)[-1] == "position"
    movable = name.endswith(("vertex_positions", CONTROL_POINTS)) or info.shape == (4, 4) or position
    asked = {"direction": _plain(direction), "rotate": _plain(rotate), "index": index}
    common = dict(scene=scene, params=params, info=info, originals=originals, how=asked)
    if movable and index is None and (rotate is not None or not _is_full_direction(direction, base)):
        return _motion(common, base, direction, rotate)
    if rotate is not None:
        raise ParameterError(f"'{name}' cannot be rotated: only vertex_positions, control_points and to_world can")
    if info.shape in ((4, 4), (3, 3)):
        raise ParameterError(f"'{name}' is a transform: give direction=(dx, dy, dz) or rotate=(ax, ay, az)")
    return _addition(common, base, direction, index)


def _plain(direction: Any) -> Any:
    """Numbers that any process understands."""
    return _numbers(direction, "the direction") if dr.is_array_v(direction) else direction


def _is_full_direction(direction: Any, base: Any) -> bool:
    """True when the direction has one number for each scalar of the parameter (and there are more than 3)."""
    if direction is None or is_transform(base):
        return False
    return np.size(direction) == dr.prod(dr.shape(base)) > 3


def _numbers(values: Any, what: str) -> np.ndarray:
    """One dimension, float64, in the flat order of parameters: x y z x y z ... of a `mi.Vector3f`, too."""
    if dr.is_array_v(values):
        array = np.array(dr.detach(values), dtype=np.float64)
        values = array.T if dr.depth_v(values) == 2 and not dr.is_tensor_v(values) else array
    try:
        array = np.asarray(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ParameterError(f"{what} must be made of numbers, got {values!r}") from error
    if not np.all(np.isfinite(array)) or not np.any(array):
        raise ParameterError(f"{what} must be finite and not all zero, got {values}")
    return array


def _motion(common: dict, base: Any, direction: Any, rotate: Any) -> Perturbation:
    """Rigid motion in world space, applied last: T(theta) @ value."""
    name = common["info"].name
    if direction is None and rotate is None:
        raise ParameterError(f"'{name}' needs a direction: direction=(dx, dy, dz) or rotate=(ax, ay, az) "
                             "(on the command line --direction, --rotate), or index= (--index) for one of its numbers")
    vector = _numbers(direction if rotate is None else rotate, "the direction of motion")
    if vector.size != 3:
        raise ParameterError(f"the direction of '{name}' must have 3 numbers, or as many as the parameter itself, "
                             f"got {vector.size}")
    centre, extent = _pivot(common, base)
    length = float(np.linalg.norm(vector))
    words = ", ".join(f"{x:g}" for x in vector)
    if rotate is not None:
        vector = vector / length

    def curve(theta: Any) -> Any:
        t = mi.Transform4f()
        if rotate is None:
            t = t.translate(mi.Vector3f(*vector.tolist()) * theta)
        else:
            t = t.translate(list(centre)).rotate(mi.Vector3f(*vector.tolist()), dr.rad2deg(theta))
            t = t.translate([-c for c in centre])
        if is_transform(base):
            return t @ base
        if isinstance(base, mi.Point3f):
            return t @ base
        if name.endswith(CONTROL_POINTS):
            return _moved_curve(t, base)
        return dr.ravel(t @ dr.unravel(mi.Point3f, base))

    label = f"translation along ({words})" if rotate is None else f"rotation about ({words}), per radian"
    return Perturbation(**common, curve=curve, label=label, rotation=rotate is not None, extent=extent,
                        scale=length, centre=centre)


def _moved_curve(t: Any, base: Any) -> Any:
    """Control points, flat, under a rigid motion: their radii stay."""
    p = dr.unravel(mi.Point4f, base)
    x = t @ mi.Point3f(p.x, p.y, p.z)
    return dr.ravel(mi.Point4f(x.x, x.y, x.z, p.w))


def _pivot(common: dict, base: Any) -> tuple[tuple[float, ...], float]:
    """Centre of rotation and size [scene units] of what moves; size 0 for sensors and lamps."""
    node = common["params"].properties[common["info"].name][2]
    if is_transform(base):
        if isinstance(node, mi.Shape):
            box = node.bbox()
            extents = np.array(box.extents(), dtype=np.float64)  # whose squares may exceed single precision
            return tuple(float(c) for c in box.center()), float(np.linalg.norm(extents))
        origin = np.array(base @ mi.Point3f(0)).ravel()
        return tuple(float(c) for c in origin), 0.0
    if isinstance(base, mi.Point3f):
        return tuple(float(c) for c in np.array(base).ravel()), 0.0
    stride = 4 if common["info"].name.endswith(CONTROL_POINTS) else 3
    points = np.array(base, dtype=np.float64).reshape(-1, stride)[:, :3]
    lo, hi = points.min(0), points.max(0)
    return tuple(float(c) for c in (lo + hi) / 2), float(np.linalg.norm(hi - lo))


def _addition(common: dict, base: Any, direction: Any, index: int | None) -> Perturbation:
    """value + theta * direction, component by component."""
    name, size = common["info"].name, int(dr.prod(dr.shape(base)))
    if index is not None:
        if not 0 <= index < size:
            raise ParameterError(f"index {index} is outside '{name}', "
                                 f"which has {size} scalars (0 to {size - 1})")
        flat, label = np.eye(1, size, index)[0], f"scalar {index}"
    elif direction is None:
        flat, label = np.ones(size), "all scalars by the same amount" if size > 1 else "its value"
    else:
        flat, label = _numbers(direction, "the direction"), "a given direction"
        if flat.size not in (1, size):
            wanted = "1 number" if size == 1 else f"1 or {size} numbers"
            raise ParameterError(f"the direction of '{name}' must have {wanted}, got {flat.size}")
        flat = np.broadcast_to(flat, (size,))
    step = _like(base, flat)
    if name.endswith(("vertex_positions", CONTROL_POINTS)):   # a deformation: its step is a length
        extent, scale = _pivot(common, base)[1], float(np.max(np.abs(flat)))
    else:
        extent, scale = 0.0, float(np.max(np.abs(np.array(base))))
    return Perturbation(**common, curve=lambda theta: base + step * theta, label=label, rotation=False,
                        extent=extent, scale=scale)


def _like(base: Any, flat: np.ndarray) -> Any:
    """`flat` (in the order of the parameter's scalars) as a value of the parameter's type."""
    flat = np.array(flat, dtype=np.float32)
    if dr.is_tensor_v(base):
        return type(base)(flat.reshape(base.shape))
    return type(base)(flat) if dr.depth_v(base) == 1 else type(base)(*flat.tolist())
