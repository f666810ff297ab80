"""The demonstration on the Cornell box: a derivative image beside finite differences, and a recovered pose.

The pose is recovered from the target image alone. Only the terms of `terms.TERMS` are in the
gradient; what is missing biases single steps, but not the pose at which the images agree.
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
from psdr_jit.scene import io as scene_io

SCENE = "cbox.xml"
PARAMETER = "small-box.vertex_positions"
MAX_DEPTH = 4           # three bounces: enough for the look of the box, a third of the cost of eight
TARGET_SPP = 256
RATE = 0.03             # Adam's step at the start [scene units]
LAST_RATE = 0.08        # its last step, relative to the first
TURN_RATE = 1.5         # step of the angle [rad] relative to that of the position


@dataclass(frozen=True)
class Stage:
    """A part of the optimisation: coarse blocks see far, fine ones see well."""

    until: float                # end, as a fraction of all iterations
    pools: tuple[int, ...]      # the loss compares means over (1/n x 1/n) parts of the image
    turn: bool                  # whether the angle takes part: useless before the position is roughly right


STAGES = (Stage(0.35, (4,), turn=False), Stage(1.0, (8, 32), turn=True))


@dataclass(frozen=True)
class Pose:
    """Displacement of the box from the scene file's placement."""

    x: float            # [scene units]
    z: float
    angle: float        # about the vertical axis through its centre [rad]


START = Pose(x=-0.38, z=0.15, angle=-0.35)


@dataclass
class Recovery:
    """What `recover_pose` did; the true pose is 0, 0, 0."""

    target: np.ndarray      # images (H, W, C)
    first: np.ndarray
    last: np.ndarray
    losses: list[float] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    px_per_unit: float = 0.0

    def shift_px(self, k: int) -> float:
        """Distance of the box from its true place at step `k`, in pixels at the box's distance."""
        return math.hypot(self.poses[k].x, self.poses[k].z) * self.px_per_unit

    def angle_degrees(self, k: int) -> float:
        return math.degrees(abs(self.poses[k].angle))


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


def place(original: Any, x: Any, z: Any, angle: Any) -> Any:
    """Vertices (flat `mi.Float`) turned by `angle` about the vertical through their centre, then moved.

    Attached where x, z and angle (width-1 `mi.Float`) are.
    """
    points = dr.unravel(mi.Point3f, original)
    centre = mi.Point3f(dr.mean(points.x), 0, dr.mean(points.z))
    p = points - centre
    c, s = dr.cos(angle), dr.sin(angle)
    moved = mi.Point3f(c * p.x + s * p.z + centre.x + x, p.y, c * p.z - s * p.x + centre.z + z)
    return dr.ravel(moved)


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
    """Displace the box by `START`, then bring it back by descending the image loss with Adam."""
    spec = integrator_specs.integrator_spec(scene, integrator)
    differentiable, plain = integrator_specs.build(spec), integrator_specs.reference(spec)
    params = mi.traverse(scene)
    params.keep(PARAMETER)
    original = mi.Float(dr.detach(params[PARAMETER]))

    def snapshot(spp: int, seed: int) -> Any:
        with dr.suspend_grad():
            return mi.render(scene, integrator=plain, spp=spp, seed=seed)

    target = snapshot(TARGET_SPP, iterations)
    opt = mi.ad.Adam(lr=RATE, beta_2=0.99)     # a short memory: gradients shrink a hundredfold
    for name in ("x", "z", "angle"):
        opt[name] = mi.Float(getattr(START, name))

    def apply() -> None:
        params[PARAMETER] = place(original, opt["x"], opt["z"], opt["angle"])
        params.update()

    apply()
    first = np.array(snapshot(TARGET_SPP // 4, iterations + 1))
    history = Recovery(np.array(target), first, first, px_per_unit=_px_per_unit(scene))
    for k in range(iterations):
        stage = next(s for s in STAGES if k < s.until * iterations or s is STAGES[-1])
        image = mi.render(scene, params, integrator=differentiable, spp=spp, seed=k)
        loss = pooled_loss(image, target, stage.pools)
        # reported: the last stage's loss, in every stage
        shown = pooled_loss(dr.detach(image), target, STAGES[-1].pools)
        history.losses.append(float(shown[0]))
        history.poses.append(Pose(*(float(opt[n][0]) for n in ("x", "z", "angle"))))
        dr.backward(loss)
        # full steps while far away, then a smooth decay so that noise averages out
        rate = RATE * LAST_RATE ** (max(0, 2 * k - iterations) / iterations)
        opt.set_learning_rate({"x": rate, "z": rate, "angle": rate * TURN_RATE if stage.turn else 0.0})
        opt.step()
        apply()
        if progress is not None:
            progress(k + 1, iterations, history)
    history.poses.append(Pose(*(float(opt[n][0]) for n in ("x", "z", "angle"))))
    history.last = np.array(snapshot(TARGET_SPP // 4, iterations + 1))
    params[PARAMETER] = original
    params.update()
    return history


def _px_per_unit(scene: Any) -> float:
    """Pixels that one scene unit spans at the distance of the box's centre."""
    sensor = scene.sensors()[0]
    points = np.array(mi.traverse(scene)[PARAMETER]).reshape(-1, 3)
    eye = np.array(sensor.world_transform() @ mi.Point3f(0)).ravel()
    fov = math.radians(float(mi.traverse(sensor)["x_fov"][0]))
    depth = float(np.linalg.norm(points.mean(0) - eye))
    return sensor.film().size()[0] / (2 * depth * math.tan(fov / 2))
