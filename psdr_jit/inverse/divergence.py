"""When a run is lost: values that leave every sensible range. Noise alone must never look like it.

A body that has left the sphere around the scene, cameras and lights, and on which the loss no longer depends, is lost
as well: nothing brings it back. Lights and cameras have a gradient wherever they are. Losses are judged by `history`.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.inverse.problem import Problem
from psdr_jit.inverse.variables import numbers
from psdr_jit.scene.params import is_transform

#: Distance from the scene, in its diameters, beyond which nothing belongs to it any more: single precision resolves
#: 1e-7 of a distance, there 1e-4 of the scene, which is a pixel.
FAR = 1e3

#: Size beyond which a value is taken for run away (times the scene's own where that is above 1): squares of larger
#: numbers overflow in single precision.
LARGEST = 1e18


class Watch:
    """Of one run. Remembers where the scene was and how large its values were when the run began."""

    def __init__(self, problem: Problem) -> None:
        points = [_origin(view.sensor.world_transform()) for view in problem.views]
        points += [p for p in map(lambda name: _points(problem, name), problem.variables) if p is not None]
        for box in (part.scene.bbox() for part in problem.parts):
            if box.valid():
                points += [numbers(box.min)[None], numbers(box.max)[None]]
        around = np.concatenate(points)
        self.centre = (around.min(0) + around.max(0)) / 2
        self.diameter = 2 * float(np.linalg.norm(around - self.centre, axis=1).max())
        self.sizes = {name: max([1.0, *(_largest(v) for v in own.values())]) for name, own in problem.own.items()}

    def reason(self, problem: Problem, latents: Any, lost: dict[str, int], iteration: int) -> str:
        """What has left its range, or "". The scene stands at `latents`; `lost`: iterations without a gradient."""
        for name, found in latents.items():
            for latent, value in found.items():
                size = _largest(value)
                if not size <= LARGEST * self.sizes[name]:
                    grown = f"has grown to {size:.0e}" if math.isfinite(size) else "is not finite"
                    return f"{name} ({latent}) {grown}"
            count = min((lost[f"{name} ({latent})"] for latent in found), default=0)
            patience = 2 * problem.settings.stalled_after * problem.period
            stalled = patience <= count <= iteration  # and has had a gradient before
            nearest, farthest = self._distances(problem, name)
            if not farthest <= FAR or (stalled and nearest > 0):
                where = f"{name} has left the scene, by {farthest:.2g} times its size"
                return f"{where}, and the loss does not depend on it any more" if farthest <= FAR else where
        return ""

    def _distances(self, problem: Problem, name: str) -> tuple[float, float]:
        """Of the nearest and the farthest point from the sphere around the scene, in its diameters."""
        points = _points(problem, name)
        if points is None or self.diameter == 0 or not points.size:
            return 0.0, 0.0
        distances = np.linalg.norm(points - self.centre, axis=1) / self.diameter - 0.5
        return float(distances.min()), float(distances.max())


def _points(problem: Problem, name: str) -> np.ndarray | None:
    """Positions (N, 3) that a parameter consists of; None if it is something else."""
    value = problem.value(name)
    if is_transform(value):
        return _origin(value) if value.matrix.shape[0] == 4 else None
    if not name.endswith(("position", "positions")):
        return None
    found = numbers(value)
    return found.reshape(-1, 3) if found.size % 3 == 0 else None


def _origin(pose: Any) -> np.ndarray:
    with dr.suspend_grad():
        return numbers(pose @ mi.Point3f(0)).reshape(-1, 3)


def _largest(value: Any) -> float:
    """NaN if there is one among them."""
    found = np.abs(numbers(value))
    return float(found.max()) if found.size else 0.0
