"""The demonstration on the Cornell box: a derivative image beside finite differences, and a recovered pose.

The pose is recovered from the target image alone, by `optimize` in two stages. Only the terms of `terms.TERMS` are in
the gradient; what is missing biases single steps, but not the pose at which the images agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.finite_differences import FiniteDifferences, finite_differences
from psdr_jit.derivative.gradient import GradientResult, gradient
from psdr_jit.inverse.loop import INTERRUPTED
from psdr_jit.inverse.optimize import optimize
from psdr_jit.inverse.variables import Pose
from psdr_jit.scene import io as scene_io

SCENE = "cbox.xml"
PARAMETER = "small-box.vertex_positions"
MAX_DEPTH = 4           # three bounces: enough for the look of the box, a third of the cost of eight
TARGET_SPP = 256
RATE = 0.03             # of position, Adam's step at the start [scene units]
TURN_RATE = 2.6         # of the angle [degrees]
LAST_RATE = 0.08        # the last steps, relative to the first
ADAM = {"type": "adam", "beta_2": 0.99}     # a short memory: gradients shrink a hundredfold
START = {"start_shift": (-0.38, 0.0, 0.15), "start_turn": (0.0, -20.0, 0.0)}    # [scene units], [degrees]


@dataclass(frozen=True)
class Stage:
    """A part of the optimisation, a run of its own: coarse blocks see far, fine ones see well."""

    pools: tuple[int, ...]      # the loss compares means over (1/n x 1/n) parts of the image
    turn_axes: str              # whether the angle takes part: useless before the position is roughly right
    decay: float                # full steps while far away, then smaller ones so that noise averages out


STAGES = (Stage((4,), turn_axes="", decay=1.0), Stage((8, 32), turn_axes="y", decay=LAST_RATE))
FIRST_STAGE = 0.35      # its share of all iterations


@dataclass
class Recovery:
    """What `recover_pose` did. Offsets are those of the box from the scene file's placement."""

    target: np.ndarray      # images (H, W, C)
    first: np.ndarray
    last: np.ndarray
    losses: list[float] = field(default_factory=list)   # of the last stage, in every stage
    offsets: list[tuple[float, float]] = field(default_factory=list)   # distance [scene units], angle [degrees]
    px_per_unit: float = 0.0

    def shift_px(self, k: int) -> float:
        """Distance of the box from its true place at step `k`, in pixels at the box's distance."""
        return self.offsets[k][0] * self.px_per_unit

    def angle_degrees(self, k: int) -> float:
        return self.offsets[k][1]


def load(res: int = 128) -> Any:
    """The Cornell box of the package at `res` x `res` pixels."""
    path = scene_io.shipped_scene(SCENE)
    return scene_io.load_scene(path, res=res, max_depth=MAX_DEPTH, rr_depth=integrator_specs.NO_ROULETTE)


def compare(scene: Any, integrator: Any = None, spp: int = 16, seeds: int = 8, reference_seeds: int = 12,
            progress: Callable[[float, float], None] | None = None,
            ) -> tuple[GradientResult, FiniteDifferences]:
    """Derivative of the image as the box moves along x: by forward mode, and by finite differences."""
    total = seeds + reference_seeds

    def shifted(before: int) -> Any:
        return None if progress is None else lambda done, _: progress(before + done, total)

    result = gradient(scene, PARAMETER, (1, 0, 0), integrator=integrator, spp=spp, seeds=seeds,
                      progress=shifted(0))
    reference = finite_differences(scene, PARAMETER, (1, 0, 0), integrator=integrator, seeds=reference_seeds,
                                   progress=shifted(seeds))
    return result, reference


def offset(original: np.ndarray, moved: np.ndarray) -> tuple[float, float]:
    """How far vertices (V, 3) are from where they were: distance of their centres, and angle [degrees] about y."""
    shift = moved.mean(0) - original.mean(0)
    a, b = original - original.mean(0), moved - moved.mean(0)
    # the rotation of the plane (x, z) that fits best in the sense of least squares
    angle = math.atan2(np.sum(a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]), np.sum(a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]))
    return float(np.linalg.norm(shift)), math.degrees(abs(angle))


def pooled_loss(image: Any, target: Any, pools: tuple[int, ...]) -> Any:
    """Sum over `pools` of the mean squared difference of block means, n x n blocks; tensors (H, W, C)."""
    height, width, channels = image.shape
    difference, loss = image - target, mi.Float(0)
    for n in pools:
        blocks = dr.reshape(difference, (n, height // n, n, width // n, channels))
        coarse = dr.mean(dr.mean(blocks, axis=3), axis=1)
        loss += dr.mean(dr.square(coarse), axis=None).array
    return loss


def recover_pose(scene: Any, integrator: Any = None, iterations: int = 60, spp: int = 8,
                 progress: Callable[[int, int, Recovery], None] | None = None) -> Recovery:
    """Displace the box by `START`, then bring it back by descending the image loss; the scene is left as it was."""
    spec = integrator_specs.integrator_spec(scene, integrator)
    differentiable, plain = integrator_specs.build(spec), integrator_specs.reference(spec, scene)
    params = mi.traverse(scene)
    params.keep(PARAMETER)
    original = mi.Float(dr.detach(params[PARAMETER]))

    def snapshot(spp: int, seed: int) -> np.ndarray:
        with dr.suspend_grad():
            return np.array(mi.render(scene, integrator=plain, spp=spp, seed=seed))

    target = snapshot(TARGET_SPP, iterations)
    _displace(scene, params)
    first = snapshot(TARGET_SPP // 4, iterations + 1)
    history = Recovery(target, first, first, px_per_unit=_px_per_unit(scene))

    def note(*_: Any) -> None:
        vertices = (np.array(dr.detach(value)).reshape(-1, 3) for value in (original, mi.traverse(scene)[PARAMETER]))
        history.offsets.append(offset(*vertices))
        if progress is not None and history.losses:
            progress(len(history.losses), iterations, history)

    note()
    first_stage = math.ceil(FIRST_STAGE * iterations)
    try:
        for k, (stage, count) in enumerate(zip(STAGES, (first_stage, iterations - first_stage), strict=True)):
            if count == 0:
                continue
            box = Pose(PARAMETER, RATE, shift_axes="xz", turn_axes=stage.turn_axes, turn_rate=TURN_RATE)
            result = optimize(scene, box, target, loss=_noting_loss(stage, history), integrator=differentiable,
                              progress=note, iterations=count, spp=spp, seed=k, decay=stage.decay, optimizer=ADAM)
            if result.status == INTERRUPTED:
                raise KeyboardInterrupt
        history.last = snapshot(TARGET_SPP // 4, iterations + 1)
    finally:
        params[PARAMETER] = original
        params.update()
    return history


def _displace(scene: Any, params: Any) -> None:
    """Put the box where the recovery starts."""
    box = Pose(PARAMETER, RATE, turn_axes="y", turn_rate=TURN_RATE, **START)
    params[PARAMETER] = box.value(box.start(box.begin(scene, params), None))
    params.update()


def _noting_loss(stage: Stage, history: Recovery) -> Callable[[Any, Any], Any]:
    """The loss of a stage, which notes that of the last one for comparison."""

    def loss(image: Any, target: Any) -> Any:
        history.losses.append(float(pooled_loss(dr.detach(image), target, STAGES[-1].pools)[0]))
        return pooled_loss(image, target, stage.pools)

    return loss


def _px_per_unit(scene: Any) -> float:
    """Pixels that one scene unit spans at the distance of the box's centre."""
    sensor = scene.sensors()[0]
    points = np.array(mi.traverse(scene)[PARAMETER]).reshape(-1, 3)
    eye = np.array(sensor.world_transform() @ mi.Point3f(0)).ravel()
    fov = math.radians(float(mi.traverse(sensor)["x_fov"][0]))
    depth = float(np.linalg.norm(points.mean(0) - eye))
    return sensor.film().size()[0] / (2 * depth * math.tan(fov / 2))
