"""What an optimisation changes: latent arrays that an optimiser steps, and how scene parameters follow from them.

A variable is any object with the attributes and methods of `Variable`; those below cover a parameter's own value and
the pose of a rigid body. `shapes` has those for meshes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.compat import pack_positions
from psdr_jit.core.upload import uploaded
from psdr_jit.core.varying import varying
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.scene.params import find_param, is_transform

AXES = "xyz"

#: Squared angle [rad²] below which sin θ / θ and (1 − cos θ) / θ² are taken from their series.
SMALL_ANGLE2 = 1e-4


class Variable(Protocol):
    """Protocol of what can be optimised."""

    parameter: str  # name of the scene parameter that follows from it
    learning_rates: Mapping[str, float]  # step of the optimiser by latent, in the latent's unit
    uniform: bool  # Adam with one step size for all entries of a latent, which keeps directions

    def begin(self, scene: mi.Scene, params: Any) -> dict[str, Any]:
        """Latents at the scene file's own values, by name; remembers what it needs of the scene."""

    def start(self, latents: dict[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
        """Latents to start from: displaced as asked for and, with `rng`, by a random amount within the spread."""

    def value(self, latents: Mapping[str, Any]) -> Any:
        """The scene parameter, attached to the latents."""

    def constrained(self, latents: dict[str, Any]) -> dict[str, Any]:
        """The nearest latents that are allowed (detached)."""

    def offset(self, latents: Mapping[str, Any]) -> dict[str, float]:
        """How far the parameter is from the scene file's own value, by name with unit."""


@dataclass
class Parameter:
    """A scene parameter's own value: colours, textures, roughness, positions, single numbers.

    `lower`, `upper`: range it is kept in, by clamping after every step. `start_at`: number or numbers to start from
    (default: the scene's own). `spread`: half-width of the random displacement of a perturbed start.
    Units are those of the parameter.
    """

    parameter: str
    learning_rate: float
    lower: float | None = None
    upper: float | None = None
    start_at: Any = None
    spread: float = 0.0
    uniform: bool = False
    _own: np.ndarray = field(default=None, init=False, repr=False)

    @property
    def learning_rates(self) -> dict[str, float]:
        return {"value": self.learning_rate}

    def begin(self, scene: mi.Scene, params: Any) -> dict[str, Any]:
        info = find_param(scene, self.parameter, params)
        if info.shape in ((4, 4), (3, 3)):
            raise ParameterError(
                f"'{self.parameter}' is a transform, whose entries cannot be stepped one by one; "
                'use a variable of kind "pose"'
            )
        if self.lower is not None and self.upper is not None and not self.lower <= self.upper:
            raise OptionError(f"'{self.parameter}': lower = {self.lower} is above upper = {self.upper}")
        value = copy_of(params[self.parameter])
        self._own = numbers(value)
        return {"value": value}

    def start(self, latents: dict[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
        value = self._own
        if self.start_at is not None:
            value = broadcast(self.start_at, value.shape, f"the start of '{self.parameter}'")
            low, high = (limit if limit is not None else default
                         for limit, default in ((self.lower, -np.inf), (self.upper, np.inf)))  # fmt: skip
            if np.any((value < low) | (value > high)):
                raise OptionError(f"'{self.parameter}' starts outside of its range from {low} to {high}")
        if rng is not None:
            value = value + self.spread * rng.uniform(-1, 1, value.shape)
        return self.constrained({"value": like(latents["value"], value)})

    def value(self, latents: Mapping[str, Any]) -> Any:
        return latents["value"]

    def constrained(self, latents: dict[str, Any]) -> dict[str, Any]:
        value = latents["value"]
        if self.lower is not None:
            value = dr.maximum(value, self.lower)
        if self.upper is not None:
            value = dr.minimum(value, self.upper)
        return {"value": value}

    def offset(self, latents: Mapping[str, Any]) -> dict[str, float]:
        return {"rms": rms(numbers(latents["value"]) - self._own)}


@dataclass
class Pose:
    """Position and orientation of a rigid body: a shape, a light or a camera.

    Latents, both 0 at the scene's own pose: `shift` [scene units] and `turn`, a rotation vector [rad]. Shapes move in
    world space about the centre of their bounding box, sensors and lights in their own frame about their own origin.
    With a `pivot` (x, y, z), all of them turn about that point in world space: a camera whose pivot is in the middle of
    what it sees converges faster, because turning then does not look like shifting.
    `shift_axes`, `turn_axes`: axes along and about which it may move, such as "xz", "y" or "".
    `start_shift`, `start_turn` [degrees]: where it starts. `spread_shift`, `spread_turn` [degrees]: half-widths of the
    random displacement of a perturbed start. A step moves by at most about `learning_rate` and `turn_rate` [degrees].
    """

    parameter: str
    learning_rate: float
    turn_rate: float = 0.0
    shift_axes: str = "xyz"
    turn_axes: str = ""
    start_shift: Sequence[float] = (0.0, 0.0, 0.0)
    start_turn: Sequence[float] = (0.0, 0.0, 0.0)
    spread_shift: float = 0.0
    spread_turn: float = 0.0
    pivot: Sequence[float] | None = None
    uniform: bool = False
    _base: Any = field(default=None, init=False, repr=False)
    _pivot: Any = field(default=None, init=False, repr=False)

    @property
    def learning_rates(self) -> dict[str, float]:
        rates = {"shift": self.learning_rate, "turn": np.deg2rad(self.turn_rate)}
        return {name: rate for name, rate in rates.items() if self._axes(name)}

    def _axes(self, latent: str) -> str:
        return self.shift_axes if latent == "shift" else self.turn_axes

    def begin(self, scene: mi.Scene, params: Any) -> dict[str, Any]:
        info = find_param(scene, self.parameter, params)
        last = self.parameter.rsplit(".", 1)[-1]
        if info.shape != (4, 4) and not last.endswith("positions") and last != "position":
            raise ParameterError(
                f"'{self.parameter}' is no pose: it takes a to_world, vertex positions, or the position "
                'of a light; use a variable of kind "parameter"'
            )
        for name in ("shift", "turn"):
            require_axes(self.parameter, f"{name}_axes", self._axes(name))
        if not self.shift_axes and not self.turn_axes:
            raise OptionError(f"'{self.parameter}': it may neither shift nor turn; give shift_axes or turn_axes")
        if info.shape != (4, 4) and last == "position" and (self.turn_axes or self.pivot is not None):
            raise OptionError(f"'{self.parameter}' is a point and cannot turn: leave out turn_axes and pivot")
        if self.turn_axes and not self.turn_rate > 0:
            raise OptionError(f"'{self.parameter}': turn_axes need a turn_rate [degrees per step] above 0")
        self._base = copy_of(params[self.parameter])
        node = params.properties[self.parameter][2]
        self._pivot = mi.Point3f(list(node.bbox().center())) if isinstance(node, mi.Shape) else None
        if self.pivot is not None:
            self._pivot = mi.Point3f(*broadcast(self.pivot, (3,), f"the pivot of '{self.parameter}'").tolist())
        dr.make_opaque(self._pivot)
        return {name: varying(mi.Vector3f, 0) for name in self.learning_rates}

    def start(self, latents: dict[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
        found = {}
        for name, value, spread in (("shift", self.start_shift, self.spread_shift),
                                    ("turn", np.deg2rad(self.start_turn), np.deg2rad(self.spread_turn))):  # fmt: skip
            move = broadcast(value, (3,), f"the start_{name} of '{self.parameter}'")
            allowed = np.array([axis in self._axes(name) for axis in AXES])
            if np.any(move[~allowed]):
                raise OptionError(
                    f"'{self.parameter}': it starts displaced along or about an axis that is not "
                    f"among {name}_axes = {self._axes(name)!r} and could never come back"
                )
            if name in latents:
                move = move if rng is None else move + spread * rng.uniform(-1, 1, 3) * allowed
                found[name] = like(latents[name], move)
        return found

    def value(self, latents: Mapping[str, Any]) -> Any:
        shift, turn = (self._allowed(latents, name) for name in ("shift", "turn"))
        if isinstance(self._base, mi.Point3f):
            return self._base + shift
        motion = rigid(shift, turn)
        if self._pivot is None:
            return self._base @ motion
        motion = mi.Transform4f().translate(self._pivot) @ motion @ mi.Transform4f().translate(-self._pivot)
        if is_transform(self._base):
            return motion @ self._base
        points = self._base if not dr.is_tensor_v(self._base) else self._base.array
        return pack_positions(motion @ dr.gather(mi.Point3f, points, dr.arange(mi.UInt32, dr.width(points) // 3)))

    def _allowed(self, latents: Mapping[str, Any], name: str) -> mi.Vector3f:
        """The latent with 0 for the axes that may not change."""
        if name not in latents:
            return mi.Vector3f(0)
        return mi.Vector3f(*(latents[name][k] if axis in self._axes(name) else 0 for k, axis in enumerate(AXES)))

    def constrained(self, latents: dict[str, Any]) -> dict[str, Any]:
        return latents

    def offset(self, latents: Mapping[str, Any]) -> dict[str, float]:
        """Distance [scene units] of the body's centre, or of a sensor's or light's origin, and angle [degrees]."""
        shift, turn = (numbers(self._allowed(latents, name)) for name in ("shift", "turn"))
        if is_transform(self._base):
            with dr.suspend_grad():
                origins = [numbers(pose @ mi.Point3f(0)) for pose in (self.value(latents), self._base)]
            shift = origins[0] - origins[1]
        found = {"distance": float(np.linalg.norm(shift)), "angle_degrees": float(np.rad2deg(np.linalg.norm(turn)))}
        kept = {"distance"} if "turn" not in latents else {"angle_degrees"} if "shift" not in latents else set(found)
        return {name: value for name, value in found.items() if name in kept}


def rigid(shift: mi.Vector3f, turn: mi.Vector3f) -> mi.Transform4f:
    """x ↦ exp([turn]×) x + shift, differentiable at turn = 0 as well.

    Rodrigues: R = I + a K + b K² with K = [turn]×, a = sin θ / θ, b = (1 − cos θ) / θ², θ = |turn|.
    """
    θ2 = dr.squared_norm(turn)
    small = θ2 < SMALL_ANGLE2
    θ2_safe = dr.select(small, 1, θ2)  # not to divide by 0 in the branch that is not taken: its adjoint is not finite
    θ = dr.sqrt(θ2_safe)
    a = dr.select(small, 1 - θ2 / 6 + θ2 * θ2 / 120, dr.sin(θ) / θ)
    b = dr.select(small, 0.5 - θ2 / 24 + θ2 * θ2 / 720, (1 - dr.cos(θ)) / θ2_safe)
    x, y, z = turn
    c = 1 - b * θ2  # the diagonal of I + b K²: 1 − b (θ² − x²)
    return mi.Transform4f(mi.Matrix4f(
        c + b * x * x, b * x * y - a * z, b * x * z + a * y, shift.x,
        b * x * y + a * z, c + b * y * y, b * y * z - a * x, shift.y,
        b * x * z - a * y, b * y * z + a * x, c + b * z * z, shift.z,
        0, 0, 0, 1,
    ))  # fmt: skip


def copy_of(value: Any) -> Any:
    """A detached copy, not a reference into the scene."""
    return type(value)(dr.detach(value))


def numbers(value: Any) -> np.ndarray:
    """All scalars of a Dr.Jit array in flat order, float64."""
    return np.array(dr.detach(value), dtype=np.float64).ravel(order="F" if _is_nested(value) else "C")


def like(value: Any, flat: np.ndarray) -> Any:
    """An array of the type and shape of `value` with the scalars `flat`; opaque. The inverse of `numbers`."""
    flat = np.asarray(flat, dtype=np.float32 if dr.is_float_v(value) else np.uint32)
    if dr.is_tensor_v(value):
        return type(value)(uploaded(dr.array_t(type(value)), flat), value.shape)
    if _is_nested(value):
        columns = flat.reshape(-1, dr.size_v(type(value))).T
        return type(value)(*(uploaded(dr.leaf_t(type(value)), column) for column in columns))
    return uploaded(type(value), flat)


def _is_nested(value: Any) -> bool:
    return dr.depth_v(value) > 1 and not dr.is_tensor_v(value)


def broadcast(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """`value` as a float64 array of this shape; `ParameterError` if it has another number of entries."""
    try:
        array = np.asarray(value, dtype=np.float64)
        array = np.broadcast_to(array if array.ndim == 0 else array.ravel(), shape)
    except (TypeError, ValueError) as error:
        raise ParameterError(
            f"{what} must be one number or {int(np.prod(shape))} of them, got {value!r:.80}"
        ) from error
    if not np.all(np.isfinite(array)):
        raise ParameterError(f"{what} is not finite")
    return array


def require_axes(parameter: str, option: str, axes: str) -> None:
    """Raises `OptionError` unless `axes` are letters out of xyz, each once at most."""
    if not set(axes) <= set(AXES) or len(set(axes)) < len(axes):
        raise OptionError(f"'{parameter}': {option} = {axes!r}: expected letters out of xyz, each once")


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
