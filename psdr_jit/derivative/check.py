"""Is a gradient right? A verdict against finite differences of the scene file's own parameter.

Three numbers decide: the gain (least-squares slope against two independent halves of finite differences), the
root mean square z-score of pixel blocks, and the largest |z|. A gradient of 0, -g or g/2 has gain 0, -1 or
1/2 and fails; so does a right answer that is not known precisely enough: that is `inconclusive`, not a pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Real
from typing import Any

import mitsuba as mi
import numpy as np

from psdr_jit.cluster.engine import Engine
from psdr_jit.cluster.source import SceneFile
from psdr_jit.core.progress import Report, reporting
from psdr_jit.core.threads import one_at_a_time
from psdr_jit.derivative import integrator_specs, show
from psdr_jit.derivative.effort import affordable, most_useful
from psdr_jit.derivative.finite_differences import CentralDifference, default_block
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.remote import RemoteDifference, RemoteSampler
from psdr_jit.derivative.sampler import DerivativeSampler, differentiable
from psdr_jit.derivative.verdict import (
    FAIL,
    INCONCLUSIVE,
    MAX_Z,
    MIN_SEEDS,
    PASS,
    SCATTER,
    SETTLED_SEEDS,
    Verdict,
    judge,
)
from psdr_jit.errors import OptionError
from psdr_jit.options import require_count
from psdr_jit.paths.aovs import Aovs

LONGEST = 0.3           # share of the time within which differences have the seeds that a verdict needs
REFINEMENTS = 2         # how often a failure is re-examined with a quarter of the step
GROSS = 0.1             # a gain off by more than this is no artefact of the step


@dataclass(frozen=True)
class CheckResult:
    """A verdict with its circumstances."""

    verdict: Verdict
    seeds: int              # of the estimator
    reference_seeds: int    # of finite differences, both halves together
    spp: int
    reference_spp: int
    eps: float
    block: int              # [px]
    seconds: float
    terms: tuple[str, ...]
    param: str
    direction: str
    estimate: np.ndarray = field(repr=False)    # mean derivative image, (H, W, C)
    reference: np.ndarray = field(repr=False)
    aovs: tuple[str, ...] = ()  # names of the last channels, those that are no colours

    @property
    def passed(self) -> bool:
        return self.verdict.verdict == PASS

    def _repr_png_(self) -> bytes:
        return show.check_png(self)

    def _repr_html_(self) -> str:
        return show.check_html(self)

    def __str__(self) -> str:
        v = self.verdict
        return "\n".join((
            f"check {self.param}, {self.direction}: {v.verdict.upper()} ({v.reason})",
            f"  terms in the estimate: {', '.join(self.terms)}",
            f"  gain {v.gain:.4f} +- {v.gain_stderr:.4f}   RMS z {v.rms_z:.3f}   max |z| {v.max_z:.2f}   "
            f"({v.blocks} blocks of {self.block} px)",
            f"  estimate {self.seeds} seeds x {self.spp} spp; finite differences {self.reference_seeds} "
            f"seeds x 2 x {self.reference_spp} spp, eps {self.eps:.3g}; {self.seconds:.1f} s"))


@one_at_a_time
def check_gradient(scene: Any, param: str | Perturbation, direction: Any = None, *, rotate: Any = None,
                   index: int | None = None, integrator: Any = None, spp: int = 64, sensor: int = 0,
                   eps: float | None = None, reference_spp: int | None = None, block: int | None = None,
                   tolerance: float = 0.02, max_stderr: float = 0.007, max_seconds: float = 120.0,
                   zero_bound: float | None = None,
                   progress: Callable[[float, Verdict], None] | bool | None = None, client: Any = None,
                   source: SceneFile | str | None = None) -> CheckResult:
    """Compare forward-mode derivatives with central differences until the verdict is certain or time is up.

    The reference is Mitsuba's `path` with the max_depth, rr_depth and hide_emitters of `integrator`. Seeds go
    to whichever of the two lowers the error of the gain more per second. Only terms of the estimate that are
    implemented are in it: where others matter, the check fails, and should. `reference_spp`: of a rendering of the
    reference, whose samples are stratified; by default so many that start-up costs little, fewer if there is no time
    for a verdict otherwise.

    `progress(seconds, verdict)` is called after every batch of seeds; True shows a bar, None does so in notebooks.
    `client`, `source`: as in `gradient`.
    """
    _require_sane(sensor, counts=dict(spp=spp, reference_spp=reference_spp, block=block),
                  reals=dict(eps=eps, max_seconds=max_seconds, tolerance=tolerance, max_stderr=max_stderr,
                             zero_bound=zero_bound))
    if not isinstance(param, Perturbation):
        param = perturb(scene, param, direction, rotate=rotate, index=index)
    if hasattr(integrator, "render_forward"):
        spec, tested = integrator_specs.path_options(integrator), integrator
        terms: list[str] = []
    else:
        spec = integrator_specs.integrator_spec(scene, integrator)
        tested, terms = differentiable(spec), integrator_specs.terms_of(spec)
    start = time.perf_counter()
    difference: Callable[..., CentralDifference] = CentralDifference
    if client is None:
        estimate = DerivativeSampler(param, tested, sensor, spp)
    else:
        engine = Engine(client, scene, source)
        estimate = RemoteSampler(engine, param, tested if tested is integrator else spec, sensor, spp)
        difference = partial(RemoteDifference, engine)
    reference = difference(param, spec, sensor, reference_spp, eps)
    rule = dict(tolerance=tolerance, max_stderr=max_stderr, zero_bound=zero_bound)
    with reporting("check", progress, partial(_noted, max_seconds)) as report, _restored(param):
        if reference_spp is None and (fewer := affordable(reference, MIN_SEEDS, LONGEST * max_seconds)) < reference.spp:
            reference_spp = fewer
            reference = difference(param, spec, sensor, fewer, eps)
        verdict, block = _collect(estimate, reference, block, start, start + max_seconds, report, rule)
        # Differences across a kink (an edge that meets the corner of a pixel block) are biased by O(eps), not
        # O(eps^2): a failure is believed only if it is gross, or if a smaller step does not cure it.
        for _ in range(REFINEMENTS if eps is None else 0):
            if verdict.verdict != FAIL or not abs(verdict.gain - 1) < GROSS:
                break
            finer = difference(param, spec, sensor, reference_spp, reference.eps / 4)
            retry, block = _collect(estimate, finer, block, start, start + max_seconds, report, rule)
            if retry.verdict == INCONCLUSIVE:
                verdict = verdict if _confirms(retry, finer.seeds, tolerance) else _in_doubt(verdict)
                break
            verdict, reference = retry, finer
    return CheckResult(verdict, estimate.seeds, 2 * reference.seeds, spp, reference.spp, reference.eps, block,
                       time.perf_counter() - start, tuple(terms) or ("all of the given integrator",),
                       param.name, param.label, estimate.images.mean(), reference.result(block).mean,
                       tuple(Aovs.parse(spec.get("aovs", "")).channels))


def _confirms(retry: Verdict, seeds: int, tolerance: float) -> bool:
    """Does a smaller step, for which there was too little time, at least point the same way as a failure?"""
    off = retry.max_z > MAX_Z or abs(retry.gain - 1) > tolerance + 2 * retry.gain_stderr
    return seeds >= MIN_SEEDS // 2 and off


def _in_doubt(verdict: Verdict) -> Verdict:
    return replace(verdict, verdict=INCONCLUSIVE, reason=f"{verdict.reason}; no time to see if a smaller step cures it")


def _noted(limit: float, report: Report) -> Callable[[float, Verdict], None]:
    """What `_collect` calls, for a bar."""
    return lambda seconds, v: report(seconds, limit, f"gain {v.gain:.3f} +- {v.gain_stderr:.3f}")


@contextmanager
def _restored(param: Perturbation) -> Iterator[None]:
    """Leaves the scene as it was found."""
    try:
        yield
    finally:
        param.restore()


def _require_sane(sensor: Any, counts: dict[str, Any], reals: dict[str, Any]) -> None:
    """Raise `OptionError` for what is given (not None) and not a positive number."""
    for name, value in counts.items():
        if value is not None:
            require_count(name, value)
    for name, value in {**counts, **reals}.items():
        if value is not None and not (isinstance(value, Real) and value > 0):
            raise OptionError(f"{name} must be a positive number, got {value!r}")
    if isinstance(sensor, mi.Sensor):
        raise OptionError("sensor must be an index: the finite differences render the scene's own sensors")


def _collect(estimate: DerivativeSampler, reference: CentralDifference, block: int | None, start: float,
             deadline: float, progress: Any, rule: dict[str, Any]) -> tuple[Verdict, int]:
    """Add seeds until `judge` decides or the deadline has passed."""
    for sampler in (estimate, reference):
        # two are needed for any statement at all, the rest only while there is time
        while sampler.seeds < 2 or (sampler.seeds < MIN_SEEDS and time.perf_counter() < deadline):
            sampler.add(max(2, sampler.at_once))
    size = estimate.images.mean().shape
    if block is not None and block > min(size[:2]):
        raise OptionError(f"block = {block} is larger than the image, {size[1]} x {size[0]} px")
    block = block or default_block(size)
    f1, f2 = reference.halves
    while True:
        verdict = judge(estimate.images, f1, f2, block, unseen=reference.unseen(block), **rule)
        now = time.perf_counter()
        if progress is not None:
            progress(now - start, verdict)
        if verdict.verdict != INCONCLUSIVE or now >= deadline:
            return verdict, block
        sampler = most_useful(estimate, reference)
        if verdict.reason.startswith(SCATTER) and min(estimate.seeds, reference.seeds) < SETTLED_SEEDS:
            sampler = estimate if estimate.seeds < reference.seeds else reference
        rate = sampler.seconds / sampler.seeds
        # growing batches keep the share of bookkeeping constant, short enough not to miss the deadline
        sampler.add(int(np.clip(min(sampler.seeds // 3, (deadline - now) / rate), sampler.at_once, 256)))
