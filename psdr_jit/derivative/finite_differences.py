"""Central differences of Mitsuba's `path` with common random numbers: the oracle for a gradient.

f = [I(theta + eps) - I(theta - eps)] / (2 eps), both sides rendered with the same seed so that the noise of
what does not change cancels. The bias is O(eps^2), the variance grows as 1/eps where edges move, hence eps is
chosen per parameter and recorded with the result. Samples of a pixel are stratified, whatever sampler the scene has.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import require_samples
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import GroupedImages, Unseen, block_means, standard_error
from psdr_jit.derivative.stratified_sensor import SAMPLER, stratified, stratified_count
from psdr_jit.errors import OptionError
from psdr_jit.scene.curve_ends import pad_curves

PIXEL_STEP = 0.1        # how far an edge moves to either side [px]; more smears the derivative image
EXTENT_STEP = 0.0075    # upper bound for moving a shape, relative to its size
ANGLE_STEP = 0.005      # upper bound for rotations [rad]
VALUE_STEP = 0.01       # relative change of colours, radiances, roughnesses
CAMERA_STEP = 0.002     # relative change of camera intrinsics: 0.1 px at the border of 100 px
PATHS_PER_RENDER = 1 << 18   # default spp: as many paths as keep start-up costs below the tracing itself
SEEN_GRID = 16          # camera rays along each side of the film that tell how far away things are
OWN = ""                # in place of a sampler: the sensor's own
FD_SEED = 0x5EED0000    # reference seeds start here, far from the seeds of the estimator


@dataclass(frozen=True)
class FiniteDifferences:
    """Two independent halves of a central difference; arrays (H, W, C), float64."""

    f1: np.ndarray
    f2: np.ndarray
    f1_stderr: np.ndarray   # standard error of block means, (h, w, C)
    f2_stderr: np.ndarray
    block: int              # block size of the errors [px]
    eps: float              # half step, in units of the direction
    spp: int                # per seed and side
    seeds: int              # per half
    seconds: float

    @property
    def mean(self) -> np.ndarray:
        return (self.f1 + self.f2) / 2


class CentralDifference:
    """Adds seeds to two independent halves of a central difference, as many as one asks for.

    `sampler`: plugin that draws the random numbers; `OWN`: that of the sensor. It may ask for a few more than `spp`.
    """

    def __init__(self, perturbation: Perturbation, spec: dict[str, Any], sensor: int = 0,
                 spp: int | None = None, eps: float | None = None, groups: int = 32, sampler: str = SAMPLER) -> None:
        if spp is not None and spp <= 0:
            raise OptionError(f"spp must be positive, got {spp}")
        if eps is not None and not eps > 0:
            raise OptionError(f"eps must be positive, got {eps}")
        self.perturbation = perturbation
        self.scene = perturbation.scene
        pad_curves(self.scene)
        self.sensor = self.scene.sensors()[sensor]
        self.integrator = integrator_specs.reference(spec, self.scene)
        self.eps = eps or default_step(perturbation, self.sensor)
        self.spp = spp or default_spp(self.sensor)
        require_samples(self.sensor, self.spp)
        self._view = self.sensor
        if sampler != OWN and not integrator_specs.draws_itself(self.integrator):
            self.spp = stratified_count(self.spp)
            self._view = stratified(self.sensor, self.spp, sampler)
        self.halves = (GroupedImages(groups), GroupedImages(groups))
        self.primal, self._primal_squares = GroupedImages(groups=1), GroupedImages(groups=1)
        self.seconds = 0.0
        self._next_seed = FD_SEED

    #: Seeds that are rendered at the same time.
    at_once = 1

    @property
    def seeds(self) -> int:
        """Seeds per half so far."""
        return self.halves[0].total

    def floor(self, block: int) -> np.ndarray:
        """Error of block means (h, w, C) that the scatter between seeds does not show.

        Rounding: the film sums `spp` samples in float32, identically for every seed where the image is the
        same. Unseen events: where no sample has met the change yet, the scatter is 0 but the error is that
        of about one sample, as bright as the surroundings.
        """
        primal = np.abs(block_means(self.primal.mean(), block))
        rounding = np.finfo(np.float32).eps * np.sqrt(self.spp) * primal / self.eps
        one_sample = self._per_sample(primal, block)
        halves = np.concatenate([half.group_means() for half in self.halves])
        seen = standard_error(block_means(halves, block)) > rounding
        return np.where(seen, rounding, np.hypot(rounding, one_sample))

    def unseen(self, block: int) -> Unseen:
        """Errors of block means that the scatter between seeds does not show."""
        return Unseen(self.floor(block), self.rare(block))

    def rare(self, block: int) -> np.ndarray:
        """What one event more or less, a sample that an edge passes over, changes of block means (h, w, C).

        Where few have occurred, the scatter between seeds is a matter of chance. An event is as bright as samples that
        are bright at all: E[L²]/E[L], of the seeds' own scatter.
        """
        mean = self.primal.mean()
        square = mean**2 + self.spp * np.maximum(self._primal_squares.mean() - mean**2, 0)
        light, power = block_means(np.abs(mean), block), block_means(square, block)
        bright = np.divide(power, light, out=np.zeros_like(power), where=light > 0)
        return self._per_sample(bright, block)

    def _per_sample(self, brightness: np.ndarray, block: int) -> np.ndarray:
        """How far a single sample of the largest brightness nearby moves block means (h, w, C)."""
        padded = np.pad(brightness, ((1, 1), (1, 1), (0, 0)))
        nearby = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1)).max((-2, -1))
        return nearby / (2 * self.eps * self.spp * block**2 * 2 * self.seeds)

    def note_primal(self, image: np.ndarray) -> None:
        """Take down the image of one seed, on one side of the difference."""
        self.primal.add(image)
        self._primal_squares.add(np.square(image, dtype=np.float64))

    def add(self, seeds: int) -> None:
        """Render `seeds` more seeds for each half: four renderings per seed."""
        start = time.perf_counter()
        numbers = [self._next_seed + k for k in range(2 * seeds)]
        self._next_seed += 2 * seeds
        for k, image in enumerate(self.differences(numbers)):
            self.halves[k % 2].add(image)
        self.seconds += time.perf_counter() - start

    def differences(self, seeds: Sequence[int]) -> list[np.ndarray]:
        """The central difference (H, W, C) of each seed: two renderings with the same random numbers."""
        self.perturbation.set_value(self.eps)
        above = [self._render(seed) for seed in seeds]
        self.perturbation.set_value(-self.eps)
        below = [self._render(seed) for seed in seeds]
        self.perturbation.restore()
        for image in above:
            self.note_primal(image)
        return [(a - b) / (2 * self.eps) for a, b in zip(above, below, strict=True)]

    def _render(self, seed: int) -> np.ndarray:
        with dr.suspend_grad():
            image = self.integrator.render(self.scene, self._view, seed=seed, spp=self.spp)
        return integrator_specs.to_image(image)

    def result(self, block: int) -> FiniteDifferences:
        one, two = self.halves
        return FiniteDifferences(one.mean(), two.mean(), one.stderr(block), two.stderr(block), block,
                                 self.eps, self.spp, self.seeds, self.seconds)


def finite_differences(scene: Any, param: str | Perturbation, direction: Any = None, *, rotate: Any = None,
                       index: int | None = None, integrator: Any = None, eps: float | None = None,
                       spp: int | None = None, seeds: int = 32, sensor: int = 0, block: int | None = None,
                       progress: Callable[[int, int], None] | None = None) -> FiniteDifferences:
    """Central differences of the scene under Mitsuba's `path`, in two independent halves.

    `integrator` (spec dict, plugin name or None) only lends its max_depth, rr_depth and hide_emitters.
    `seeds` counts per half; each seed costs four renderings of `spp` samples per pixel, or the few more that
    `stratified_count` says.
    """
    if seeds < 1:
        raise OptionError(f"seeds must be positive, got {seeds}")
    if not isinstance(param, Perturbation):
        param = perturb(scene, param, direction, rotate=rotate, index=index)
    spec = integrator_specs.integrator_spec(scene, integrator)
    difference = CentralDifference(param, spec, sensor, spp, eps)
    while difference.seeds < seeds:
        difference.add(min(4, seeds - difference.seeds))
        if progress is not None:
            progress(difference.seeds, seeds)
    return difference.result(block or default_block(difference.halves[0].mean().shape))


def default_block(shape: tuple[int, ...]) -> int:
    """Block size [px] that leaves about 16 blocks along the shorter side."""
    return max(1, min(shape[0], shape[1]) // 16)


def default_spp(sensor: Any) -> int:
    pixels = int(np.prod(sensor.film().crop_size()))
    return int(np.clip(PATHS_PER_RENDER // pixels, 4, 1024))


def default_step(perturbation: Perturbation, sensor: Any) -> float:
    """Half step eps, in units of the perturbation's direction.

    Motions: edges move by about `PIXEL_STEP` pixels, and never by more than a small part of the shape.
    Values: a small relative change.
    """
    p = perturbation
    if not p.moves:
        relative = CAMERA_STEP if p.info.kind == "camera" else VALUE_STEP
        return relative * (p.scale or 1.0)
    # a camera moves everything, so the distance that counts is that of the scene
    box, is_camera = p.scene.bbox(), p.info.kind == "camera"
    target = np.array(p.centre if p.centre and not is_camera else box.center(), dtype=float)
    eye = np.array(sensor.world_transform() @ mi.Point3f(0)).ravel()[:3]
    radians_per_px = _pixel_angle(sensor)
    size = float(np.linalg.norm(np.array(box.extents(), dtype=np.float64)))
    # what is seen may be close by in a scene that reaches far: on a large ground, say
    away, seen = float(np.linalg.norm(target - eye)), seen_distance(p.scene, sensor)
    px = radians_per_px * (min(max(away, 0.1 * size), seen) if is_camera else max(away, min(0.1 * size, seen)))
    if p.rotation:
        angle = radians_per_px if is_camera else px / (p.extent / 2 or 1.0)
        return min(ANGLE_STEP, PIXEL_STEP * angle)
    limit = EXTENT_STEP * (p.extent or size)
    return min(limit, PIXEL_STEP * px) / p.scale


def seen_distance(scene: mi.Scene, sensor: Any) -> float:
    """Median distance of what a coarse grid of camera rays meets [scene units]; infinite if that is nothing."""
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, SEEN_GRID**2)
        film = (mi.Point2f(mi.Float(i % SEEN_GRID), mi.Float(i // SEEN_GRID)) + 0.5) / SEEN_GRID
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, film, mi.Point2f(0.5))  # all have it
        t = np.array(scene.ray_intersect_preliminary(ray, coherent=True).t)
    met = t[np.isfinite(t)]
    return float(np.median(met)) if len(met) else np.inf


def _pixel_angle(sensor: Any) -> float:
    """Angle of view of one pixel [rad]; 1 degree when the sensor has no field of view."""
    params = mi.traverse(sensor)
    fov = float(np.array(params["x_fov"]).ravel()[0]) if "x_fov" in params else float(sensor.film().size()[0])
    return float(np.deg2rad(fov)) / int(sensor.film().size()[0])
