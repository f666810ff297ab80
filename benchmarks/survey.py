"""What becomes of scene files that others have written: each thing that can move is moved a little and checked.

`survey(folder)` gives a row for each scene and parameter: computed, undecided, warned, refused, wrong or not finite.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.check import CheckResult
from psdr_jit.derivative.finite_differences import seen_distance
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler
from psdr_jit.derivative.verdict import FAIL, PASS
from psdr_jit.errors import PsdrError, UnsupportedWarning
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.params import ParamInfo, differentiable_params

COMPUTED, UNDECIDED, WARNED, REFUSED, WRONG, NOT_FINITE = (
    "computed", "undecided", "warned", "refused", "wrong", "not finite",
)  # fmt: skip

SIDE = 24  # longer side of the image [px]
DEPTH = 3  # of paths, at most
LOOK_SPP = 4  # of the derivative that tells whether there is one
DIRECTIONS = ((0.6, 0.3, -0.5), (1, 0, 0), (0, 1, 0), (0, 0, 1))  # of motions, in the order in which they are tried
AXIS = (0.2, 1, 0.3)  # of turns
ASIDE, SKEW = 0.01, (0.8, 0.5, 0.3)  # how far cameras are moved, relative to what they see, and where to
FINER = 6.0  # by how much the step of a second look at what seems wrong is smaller
PARTS = "flush contact"  # what warnings of motions that part things say
TOLERANCE = 0.05  # of the gain: a few seconds of a noisy scene know no better


@dataclass(frozen=True)
class Effort:
    """What a check may take: seconds (0: nothing is checked) and samples per pixel of a rendering (None: the default).

    Where renderings are quick and calls are slow, as on a GPU, many samples make the most of the seconds.
    """

    seconds: float
    spp: int = 64
    reference_spp: int | None = None


@dataclass(frozen=True)
class Row:
    scene: str
    param: str
    word: str
    gain: float | None
    stderr: float | None
    reason: str
    seconds: float
    motion: str = ""  # empty: none was tried to the end

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def survey(folder: Path, seconds: float, most: int | None = None) -> Iterator[Row]:
    """Rows of all scene files in `folder` and below; a check may take so many seconds, 0: nothing is checked.

    `most`: how many things of a scene are moved, evenly spread over all that can be; None: all.
    """
    for path in sorted(folder.rglob("*.xml")):
        start = time.perf_counter()
        try:
            scene = shrunk(scene_io.load_scene(path))
        except PsdrError as error:
            yield Row(path.name, "", REFUSED, None, None, str(error), time.perf_counter() - start)
            continue
        for info in spread(movable(scene), most):
            yield row_of(scene, path.name, info, Effort(seconds))


def spread(infos: list[ParamInfo], most: int | None) -> list[ParamInfo]:
    """At most so many, the first and the last among them."""
    if most is None or len(infos) <= most:
        return infos
    return [infos[k] for k in np.linspace(0, len(infos) - 1, most).round().astype(int)]


def shrunk(scene: mi.Scene) -> mi.Scene:
    """With films of `SIDE` pixels, whatever the file says, and cameras a little aside.

    In symmetric scenes edges lie on the border of two pixels. Seen by a box filter, they leave the one and enter the
    other: there is no derivative, and differences find the mean of those to either side.
    """
    params = psdr_jit.traverse(scene)
    for name in [key for key in params.keys() if key.endswith("film.size")]:
        size = np.array(params[name], dtype=float)
        small = [max(8, round(SIDE * s / size.max())) for s in size]
        film = name.removesuffix("size")
        params[name], params[f"{film}crop_size"], params[f"{film}crop_offset"] = small, small, [0, 0]
    params.update()
    size = float(np.array(scene.bbox().extents()).max()) if scene.bbox().valid() else 0.0
    for sensor in scene.sensors():
        own = mi.traverse(sensor)
        if "to_world" in own:
            shift = ASIDE * min(size, seen_distance(scene, sensor))
            own["to_world"] = mi.Transform4f().translate([shift * x for x in SKEW]) @ own["to_world"]
            own.update()
    return scene


def movable(scene: mi.Scene) -> list[ParamInfo]:
    """Shapes, lights and the first camera: vertices, poses and positions."""
    names = (".vertex_positions", ".to_world", ".position")
    first = psdr_jit.traverse(scene.sensors()[0])
    cameras = 0
    found = []
    for info in differentiable_params(scene):
        if info.differentiable and info.name.endswith(names):
            cameras += info.kind == "camera"
            if info.kind != "camera" or (cameras == 1 and "to_world" in first):
                found.append(info)
    return found


def row_of(scene: mi.Scene, file: str, info: ParamInfo, effort: Effort) -> Row:
    """Move one thing, and compare if there are seconds for it.

    Along the first of `DIRECTIONS` that parts nothing that touches, if there is one: where things touch, a derivative
    to one side differs from that to the other, and no difference knows which.
    """
    start = time.perf_counter()

    def row(word: str, reason: str = "", gain: float | None = None, stderr: float | None = None, motion="") -> Row:
        return Row(file, info.name, word, gain, stderr, reason, time.perf_counter() - start, motion)

    looks: list[_Look] = []
    for how in _motions(info):
        try:
            looks.append(_look(scene, info.name, how))
        except PsdrError as error:
            return row(REFUSED, str(error))
        if looks[-1].not_finite:
            return row(NOT_FINITE, f"{looks[-1].not_finite} samples or pixels were not finite")
        if not looks[-1].parts:
            break
    look = looks[-1] if not looks[-1].parts else looks[0]
    if look.warnings:
        return row(WARNED, look.warnings[0])
    if effort.seconds == 0:
        return row(COMPUTED)
    check = _checked(scene, info.name, look, effort)
    if check.verdict.verdict == FAIL:  # a step too large, as where faces turn away from a point of light one by one?
        check = _checked(scene, info.name, look, effort, check.eps / FINER)
    verdict = check.verdict
    rejected = integrator_specs.rejected(look.integrator)
    if rejected or not np.isfinite(check.estimate).all():
        return row(NOT_FINITE, f"{rejected} samples were not finite")
    word = {PASS: COMPUTED, FAIL: WRONG}.get(verdict.verdict, UNDECIDED)
    gain, stderr = (x if np.isfinite(x) else None for x in (verdict.gain, verdict.gain_stderr))
    return row(word, verdict.reason, gain, stderr, check.direction)


@dataclass(frozen=True)
class _Look:
    """A derivative of few samples, and what was said about it."""

    how: dict[str, Any]  # keywords of `perturb`
    integrator: Any  # of its own: an integrator warns once
    warnings: tuple[str, ...]
    not_finite: int  # samples, and pixels

    @property
    def parts(self) -> bool:
        """Does the motion part what touches?"""
        return any(PARTS in text for text in self.warnings)


def _motions(info: ParamInfo) -> list[dict[str, Any]]:
    """How a thing is moved: lights that are nowhere are turned."""
    turned = info.kind == "emitter" and info.name.endswith("to_world")
    return [{"rotate": AXIS}] if turned else [{"direction": direction} for direction in DIRECTIONS]


def _integrator(scene: mi.Scene) -> Any:
    spec = integrator_specs.integrator_spec(scene, "psdr_path")
    depth = spec.get("max_depth", -1)
    spec["max_depth"] = DEPTH if depth < 0 else min(depth, DEPTH)
    return integrator_specs.build(spec)


def _look(scene: mi.Scene, param: str, how: dict[str, Any]) -> _Look:
    integrator = _integrator(scene)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        sampler = DerivativeSampler(perturb(scene, param, **how), integrator, 0, LOOK_SPP)
        sampler.add(1)
    missing = tuple(str(w.message) for w in said if issubclass(w.category, UnsupportedWarning))
    pixels = int(np.sum(~np.isfinite(sampler.images.mean())))
    return _Look(how, integrator, missing, sampler.not_finite + pixels)


def _checked(scene: mi.Scene, param: str, look: _Look, effort: Effort, eps: float | None = None) -> CheckResult:
    return psdr_jit.check_gradient(scene, param, **look.how, integrator=look.integrator, eps=eps,
                                   max_seconds=effort.seconds, spp=effort.spp, reference_spp=effort.reference_spp,
                                   tolerance=TOLERANCE, max_stderr=TOLERANCE / 2)  # fmt: skip


def table(rows: list[Row]) -> str:
    """Markdown, a line for each row."""
    lines = ["| scene | parameter | result | gain | reason |", "|---|---|---|---|---|"]
    for r in rows:
        gain = "" if r.gain is None or r.stderr is None else f"{r.gain:.3f} ± {r.stderr:.3f}"
        lines.append(f"| {r.scene} | {r.param} | {r.word} | {gain} | {r.reason.splitlines()[0]} |")
    return "\n".join(lines)
