"""The optimisation loop: evaluate, step, constrain, log, checkpoint."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from psdr_jit.errors import CheckpointError, ClusterError, OptionError, StalledWarning, ZeroDerivativeWarning
from psdr_jit.inverse import checkpoint as checkpoints
from psdr_jit.inverse import lock, show
from psdr_jit.inverse.checkpoint import Checkpoint
from psdr_jit.inverse.control_variate import Single, estimates_of
from psdr_jit.inverse.divergence import Watch
from psdr_jit.inverse.history import History
from psdr_jit.inverse.interruption import interruptible
from psdr_jit.inverse.journal import Journal
from psdr_jit.inverse.observer import Observer, Seen
from psdr_jit.inverse.problem import Latents, Problem, copied
from psdr_jit.inverse.variables import like, numbers

FINISHED, OUT_OF_TIME, DIVERGED, INTERRUPTED = "finished", "out of time", "diverged", "interrupted"

#: Relative difference of a target's mean up to which it is the same target: renders differ by rounding.
SAME_TARGET = 1e-2


@dataclass
class Result:
    """What became of a run. The scene is left at `latents`."""

    status: str  # "finished", "out of time", "diverged" or "interrupted"
    iterations: int  # that have been done, in all runs together
    seconds: float  # of all runs together, without reading and checking the problem
    losses: list[float] = field(repr=False)  # by iteration of this run, before its step
    loss: float  # mean of the last few; NaN without any
    latents: Latents = field(repr=False)  # detached
    offsets: dict[str, dict[str, float]]  # from the scene's own values, now ...
    start_offsets: dict[str, dict[str, float]]  # ... and at the start
    not_written: list[str] = field(default_factory=list)  # what the disk did not take ...
    lost: dict[str, str] = field(default_factory=dict)  # ... and of that the final values, with the reason
    folder: Path | None = None  # with log, pictures and values

    def _repr_png_(self) -> bytes:
        return show.result_png(self)

    def _repr_html_(self) -> str:
        return show.result_html(self)


@dataclass
class _State:
    """What changes from iteration to iteration."""

    latents: Latents
    optimisers: dict[str, Any]  # by parameter
    history: History
    estimates: Single  # of the images that the loss sees
    iteration: int = 0
    seconds: float = 0.0  # of runs before this one
    lost: dict[str, int] = field(default_factory=dict)  # iterations in a row without a usable gradient, by latent
    norms: dict[str, float] = field(default_factory=dict)  # of the latest gradient, by latent
    began: float = field(default_factory=time.perf_counter)

    def clock(self) -> float:
        """Seconds of all runs together."""
        return self.seconds + time.perf_counter() - self.began


def run(
    problem: Problem,
    folder: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
    observers: Sequence[Observer] = (),
) -> Result:
    """Optimise; with a `folder`, log there, checkpoint, and `resume` from it. See `psdr_jit.optimize`."""
    require_folder(folder, resume)
    if folder is None:
        return _run(problem, None, False, progress, observers)
    with lock.held(folder):
        require_folder(folder, resume, mine=True)  # a run may have ended here in between
        return _run(problem, folder, resume, progress, observers)


def _run(problem: Problem, folder: Path | None, resume: bool, progress: Any, observers: Sequence[Observer]) -> Result:
    state = begin(problem)
    if resume:
        _restore(problem, state, checkpoints.load(folder / checkpoints.NAME, problem.fingerprint))
    journal = Journal(folder, problem, keep=state.iteration, observers=observers)
    losses: list[float] = []
    with journal.closed_after(state):
        try:
            journal.picture(problem, problem.start())
            journal.begin(problem)
            with warnings.catch_warnings():
                # said once it has lasted, with the variable's name; entered once, or "once" would mean every iteration
                warnings.simplefilter("ignore", ZeroDerivativeWarning)
                status = _loop(problem, state, journal, losses, progress)
            if status != DIVERGED:
                journal.keep(_checkpoint(problem, state), last=status == INTERRUPTED)
            found = copied(state.history.best if status == DIVERGED else state.latents)
            problem.apply(found)
            start = problem.offsets(problem.start())
            result = Result(status, state.iteration, state.clock(), losses, state.history.mean, found,
                            problem.offsets(found), start)  # fmt: skip
            if status != INTERRUPTED:
                journal.finish(problem, result)
        except ClusterError:  # nothing has been stepped since
            journal.keep(_checkpoint(problem, state))
            raise
    result.not_written, result.lost, result.folder = journal.not_written, journal.lost, folder
    return result


def require_folder(folder: Path | None, resume: bool, mine: bool = False) -> None:
    """Raise typed errors if there is nothing to resume from, a run that would be overwritten, or one at work there.

    `mine`: its lock is held by the caller.
    """
    if resume and folder is None:
        raise OptionError("resuming needs the folder of the run that was interrupted")
    if folder is not None and not mine:
        lock.require_free(folder)
    if resume:
        checkpoints.require(folder / checkpoints.NAME)
    if not resume and folder is not None and (folder / checkpoints.NAME).exists():
        raise OptionError(
            f"'{folder}' holds an earlier run: go on with it (resume=True, --resume), choose another folder (out=..., "
            "--out), or remove it"
        )


class Stepper:
    """The loop taken apart: one iteration at a time, without files. For measurements and loops of one's own."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._state = begin(problem)
        problem.apply(self._state.latents)
        self._journal = Journal(None, problem, keep=0)

    def step(self) -> float:
        """One iteration; the loss before its step."""
        loss = _iterate(self.problem, self._state, self._journal)
        self._state.iteration += 1
        return loss

    @property
    def latents(self) -> Latents:
        """As they are now, detached."""
        return copied(self._state.latents)

    def arrays(self) -> dict[str, np.ndarray]:
        """Values and moments of all optimisers."""
        return checkpoints.optimiser_arrays(self._state.optimisers)


def _loop(problem: Problem, state: _State, journal: Journal, losses: list[float], progress: Any) -> str:
    """Iterate until there is a reason to stop, and return it."""
    settings = problem.settings
    problem.apply(problem.start())
    watch = Watch(problem)  # of where the run began, also when it is resumed
    problem.apply(state.latents)
    with interruptible() as interrupted:
        while state.iteration < settings.iterations:
            if interrupted:
                return INTERRUPTED
            if settings.max_seconds is not None and state.clock() > settings.max_seconds:
                return OUT_OF_TIME
            losses.append(_iterate(problem, state, journal))
            lost = _is_lost(problem, state) or watch.reason(problem, state.latents, state.lost, state.iteration)
            if lost:
                _say_diverged(state, lost)
                return DIVERGED
            state.iteration += 1
            if state.iteration % settings.checkpoint_every == 0:
                journal.keep(_checkpoint(problem, state))
            if progress is not None:
                progress(state.iteration, settings.iterations, _note(problem, state, losses))
    return FINISHED


def _is_lost(problem: Problem, state: _State) -> str:
    """What the losses and gradients say against going on, or ""."""
    history, patience = state.history, problem.settings.stalled_after
    if history.diverges(problem.settings.diverged_factor):
        return f"the loss diverged (now {history.recent[-1]:.3e}, at first {history.scale:.3e})"
    if history.regressed:
        return (f"the loss has been above the first ones for {history.above} iterations (now {history.mean:.3e}) and "
                f"was {history.best_loss:.3e} before")  # fmt: skip
    broken = [name for name, norm in state.norms.items() if not math.isfinite(norm)]
    if any(state.lost[name] >= patience for name in broken):
        return f"the gradient of {', '.join(broken)} has not been finite for {patience} iterations"
    return ""


def _note(problem: Problem, state: _State, losses: list[float]) -> str:
    each = (time.perf_counter() - state.began) / len(losses)
    left = each * (problem.settings.iterations - state.iteration)
    norms = " ".join(f"{value:.1e}" for value in state.norms.values())
    return f"loss {losses[-1]:.3e}  |gradient| {norms}  {each:.2f} s/it  {left:.0f} s left"


def _say_diverged(state: _State, what: str) -> None:
    best = state.history.best_loss
    known = f"the best state (loss {best:.3e})" if math.isfinite(best) else "the start"
    said = f"{what} at iteration {state.iteration}: stopped, {known} is kept; lower the learning rates, or raise spp"
    warnings.warn(said, RuntimeWarning, stacklevel=5)


def begin(problem: Problem) -> _State:
    latents = problem.start()
    history = History(problem.period, problem.loss.images > 1, copied(latents))
    optimisers = {}
    for name, variable in problem.variables.items():
        opt = optimisers[name] = problem.settings.make_optimizer(variable.uniform)
        for latent, value in latents[name].items():
            opt[latent] = value
            latents[name][latent] = opt[latent]
        checkpoints.make_opaque(opt)  # counters start as literals: the first step would have kernels of its own
    return _State(latents, optimisers, history, estimates_of(problem.settings.control_variate))


def _restore(problem: Problem, state: _State, stored: Checkpoint) -> None:
    if not np.allclose(stored.history["targets"], problem.target_means, rtol=SAME_TARGET):
        raise CheckpointError("the checkpoint belongs to other targets; use another output folder, or remove it")
    checkpoints.restore_optimisers(state.optimisers, stored.arrays)
    best: Latents = {name: {} for name in state.latents}
    for name, latents in state.latents.items():
        for latent in latents:
            latents[latent] = state.optimisers[name][latent]
            best[name][latent] = like(dr.detach(latents[latent]), stored.best[f"{name}/{latent}"])
    state.iteration, state.seconds = stored.iteration, stored.seconds
    state.history.restore(stored.history, best)
    state.estimates.restore(stored.images)


def _checkpoint(problem: Problem, state: _State) -> Checkpoint:
    best = {f"{name}/{latent}": numbers(v) for name, of in state.history.best.items() for latent, v in of.items()}
    history = {**state.history.arrays(), "targets": problem.target_means}
    arrays, images = checkpoints.optimiser_arrays(state.optimisers), state.estimates.arrays()
    return Checkpoint(state.iteration, problem.fingerprint, arrays, best, history, state.clock(), images)


def _iterate(problem: Problem, state: _State, journal: Journal) -> float:
    """One step of every optimiser, from where the scene stands; the loss before it."""
    start = time.perf_counter()
    before = copied(state.latents)
    loss, images = problem.evaluate(state.iteration, state.estimates)
    state.estimates.settle()
    state.history.add(loss, before)
    rate = problem.rate(state.iteration)
    state.norms = {}
    for name, variable in problem.variables.items():
        _step(problem, state, name, variable, rate)
    seen = Seen(state.iteration, loss, rate, state.norms, problem.offsets(before), before, images)
    journal.show(seen)
    problem.apply(state.latents)
    journal.step(seen, time.perf_counter() - start, problem)
    return loss


def _step(problem: Problem, state: _State, name: str, variable: Any, rate: float) -> None:
    """Move one variable, unless its gradient is not finite."""
    opt, latents = state.optimisers[name], state.latents[name]
    norms = {latent: float(np.linalg.norm(numbers(dr.grad(opt[latent])))) for latent in latents}
    for latent, norm in norms.items():
        label = f"{name} ({latent})"
        state.norms[label] = norm
        _watch(problem, state, label, norm)
    if all(map(math.isfinite, norms.values())):
        opt.set_learning_rate({latent: rate * lr for latent, lr in variable.learning_rates.items()})
        opt.step()
    for latent, value in variable.constrained({k: dr.detach(opt[k]) for k in latents}).items():
        opt[latent] = value
        latents[latent] = opt[latent]


def _watch(problem: Problem, state: _State, label: str, norm: float) -> None:
    """Count iterations without a gradient; warn once if that lasts, with the reason that the plan gives."""
    usable = math.isfinite(norm) and norm > 0
    count = state.lost[label] = 0 if usable else state.lost.get(label, 0) + 1
    if norm != 0 or count != problem.settings.stalled_after:
        return
    plan = getattr(problem.home(label.rpartition(" (")[0]).integrator, "plan", None)
    terms = [f"{t.name} {'runs' if t.runs else 'is out'}: {t.reason}" for t in plan.terms] if plan is not None else []
    reason = f"; the latest plan: {'; '.join(terms)}" if terms else ""
    said = (
        f"the loss has not depended on {label} for {count} iterations (its gradient is 0): is it seen, or does it cast "
        f"light or shadow on what is seen?{reason}"
    )
    warnings.warn(said, StalledWarning, stacklevel=7)
