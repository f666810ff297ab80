"""Variables that change the shape of a mesh: vertex by vertex, or the cross-section of an extruded object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.compat import VERTEX_POSITIONS
from psdr_jit.core.upload import uploaded
from psdr_jit.errors import OptionError, ParameterError, SetupError
from psdr_jit.inverse.variables import AXES, copy_of, like, numbers, require_axes, rms
from psdr_jit.scene.params import find_param

#: Distance in the cross-section, relative to its extent, below which vertices belong to the same point of it.
SAME_POINT = 1e-4

#: Share of the median radius of a cross-section within which its points belong to the caps, and stay.
INNER = 0.2

#: What `mi.ad.LargeSteps` solves with.
SOLVER = "cholespy"

#: Waves around a cross-section that a perturbed start is made of.
WAVES = 6


@dataclass
class Vertices:
    """All vertices of a mesh, in coordinates that diffuse their gradients over the surface.

    Nicolet et al. 2021, "Large Steps in Inverse Rendering of Geometry": the latent is u = (I + λ L) v with
    λ = `smoothness` and L the mesh's Laplacian (`mi.ad.LargeSteps`, which needs the package `cholespy`);
    `smoothness = 0` steps the positions themselves. `learning_rate` is in scene units.
    `spread`: a perturbed start is stretched along every axis by up to this factor and shifted by up to this share of
    its size, and displaced by `spread_bumps` [scene units, rms], smooth as steps are, each vertex at random.
    `axes`: along which vertices move, such as "xyz"; a sheet across y that moves along "y" alone is a height field.
    """

    parameter: str
    learning_rate: float
    smoothness: float = 19.0
    spread: float = 0.0
    spread_bumps: float = 0.0
    axes: str = AXES
    uniform: bool = True
    _own: np.ndarray = field(default=None, init=False, repr=False)
    _steps: Any = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        """Says what is missing before scenes are loaded and targets rendered."""
        if not self.smoothness > 0:
            return
        try:
            import_module(SOLVER)
        except ImportError as error:
            raise SetupError(
                f"'{self.parameter}': smooth steps need the package '{SOLVER}' ('{error.name}' is missing): pip "
                f"install {SOLVER}, or set smoothness = 0"
            ) from error

    @property
    def learning_rates(self) -> dict[str, float]:
        return {"u": self.learning_rate}

    def begin(self, scene: mi.Scene, params: Any) -> dict[str, Any]:
        positions = _positions(scene, self.parameter, params)
        if not self.smoothness >= 0:
            raise OptionError(f"'{self.parameter}': smoothness = {self.smoothness} must not be negative")
        require_axes(self.parameter, "axes", self.axes)
        if not self.axes:
            raise OptionError(f"'{self.parameter}': axes = '': expected letters out of xyz, or it may not move")
        self._own = numbers(positions)
        if self.smoothness > 0:
            faces = mi.UInt32(params[self.parameter[: -len(VERTEX_POSITIONS)] + "faces"])
            self._steps = mi.ad.LargeSteps(positions, faces, self.smoothness)
        return {"u": self._latent(positions)}

    def _latent(self, positions: mi.Float) -> mi.Float:
        found = positions if self._steps is None else self._steps.to_differential(positions)
        dr.make_opaque(found)
        return found

    def start(self, latents: dict[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
        if rng is None:
            return latents
        p = self._own.reshape(-1, 3)
        centre, size = (p.max(0) + p.min(0)) / 2, np.ptp(p, axis=0).max()
        moved = centre + (p - centre) * (1 + self.spread * rng.uniform(-1, 1, 3))
        moved += self.spread * size * rng.uniform(-1, 1, 3) / 2
        if self.spread_bumps > 0:
            bumps = numbers(self._positions(uploaded(mi.Float, rng.normal(size=p.size).astype(np.float32))))
            moved += (bumps * (self.spread_bumps / rms(bumps))).reshape(-1, 3)
        return {"u": self._latent(uploaded(mi.Float, np.where(self._free, moved, p).astype(np.float32)))}

    def value(self, latents: Mapping[str, Any]) -> Any:
        found = self._positions(latents["u"])
        if all(self._free):
            return found
        axis = dr.arange(mi.UInt32, dr.width(found)) % len(AXES)
        free = dr.gather(mi.Bool, mi.Bool(self._free), axis)
        return dr.select(free, found, uploaded(mi.Float, self._own.astype(np.float32)))

    @property
    def _free(self) -> list[bool]:
        """By axis: may vertices move along it?"""
        return [axis in self.axes for axis in AXES]

    def _positions(self, u: mi.Float) -> mi.Float:
        return u if self._steps is None else self._steps.from_differential(u)

    def constrained(self, latents: dict[str, Any]) -> dict[str, Any]:
        return latents

    def offset(self, latents: Mapping[str, Any]) -> dict[str, float]:
        with dr.suspend_grad():
            return {"rms": rms(numbers(self.value(latents)) - self._own)}


@dataclass
class Profile:
    """The cross-section of an extruded object: one number per point of it, which moves a whole column of vertices.

    Vertices that share a place in the plane across `axis` form a column; the latent is its displacement away from the
    middle of the cross-section [scene units]. Columns near the middle, which only caps have, stay.
    `start_at`: "own", or "round" for one circle of the same
    mean radius. `spread`: amplitude of the random waves of a perturbed start [scene units].
    """

    parameter: str
    learning_rate: float
    axis: str = "y"
    start_at: str = "own"
    spread: float = 0.0
    uniform: bool = False
    _own: mi.Point3f = field(default=None, init=False, repr=False)
    _column: mi.UInt32 = field(default=None, init=False, repr=False)
    _outward: mi.Vector3f = field(default=None, init=False, repr=False)
    _radius: np.ndarray = field(default=None, init=False, repr=False)
    _angle: np.ndarray = field(default=None, init=False, repr=False)

    @property
    def learning_rates(self) -> dict[str, float]:
        return {"displacement": self.learning_rate}

    def begin(self, scene: mi.Scene, params: Any) -> dict[str, Any]:
        if self.axis not in tuple(AXES):
            raise OptionError(f"'{self.parameter}': axis = {self.axis!r}: expected x, y or z")
        if self.start_at not in ("own", "round"):
            raise OptionError(f'\'{self.parameter}\': start_at = {self.start_at!r}: expected "own" or "round"')
        p = numbers(_positions(scene, self.parameter, params)).reshape(-1, 3)
        across = [k for k, name in enumerate(AXES) if name != self.axis]
        column, points = _columns(p[:, across])
        arm = points - (points.max(0) + points.min(0)) / 2
        radius = np.linalg.norm(arm, axis=1)
        outer = radius > INNER * np.median(radius)
        ring = np.cumsum(outer) - 1  # number of a column among those that move
        outward = np.zeros((len(p), 3))
        outward[:, across] = np.where(outer[:, None], arm / np.maximum(radius, 1e-30)[:, None], 0)[column]
        self._radius, self._angle = radius[outer], np.arctan2(arm[outer, 1], arm[outer, 0])
        self._column = uploaded(mi.UInt32, np.maximum(ring[column], 0).astype(np.uint32))
        self._own, self._outward = (kind(*(uploaded(mi.Float, column) for column in values.T.astype(np.float32)))
                                    for kind, values in ((mi.Point3f, p), (mi.Vector3f, outward)))  # fmt: skip
        return {"displacement": dr.zeros(mi.Float, int(outer.sum()))}

    def start(self, latents: dict[str, Any], rng: np.random.Generator | None) -> dict[str, Any]:
        move = np.zeros(len(self._radius)) if self.start_at == "own" else self._radius.mean() - self._radius
        if rng is not None:
            for wave in range(1, WAVES + 1):
                move = move + self.spread / WAVES * rng.normal() * np.cos(
                    wave * self._angle + rng.uniform(0, 2 * np.pi)
                )
        return {"displacement": like(latents["displacement"], move)}

    def value(self, latents: Mapping[str, Any]) -> Any:
        move = dr.gather(mi.Float, latents["displacement"], self._column)
        return dr.ravel(self._own + self._outward * move)

    def constrained(self, latents: dict[str, Any]) -> dict[str, Any]:
        return latents

    def offset(self, latents: Mapping[str, Any]) -> dict[str, float]:
        return {"rms": rms(numbers(latents["displacement"]))}


def _positions(scene: mi.Scene, name: str, params: Any) -> mi.Float:
    find_param(scene, name, params)
    if not name.endswith(VERTEX_POSITIONS):
        raise ParameterError(f"'{name}' holds no vertices; the parameter of a mesh ends in .{VERTEX_POSITIONS}")
    value = copy_of(params[name])
    return value.array if dr.is_tensor_v(value) else value


def _columns(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the column of each vertex, and the place (x, y) of each column."""
    cell = SAME_POINT * np.ptp(points, axis=0).max()
    _, first, column = np.unique(np.round(points / cell), axis=0, return_index=True, return_inverse=True)
    return column.ravel(), points[first]
