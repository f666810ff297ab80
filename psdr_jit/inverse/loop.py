"""The optimisation loop: evaluate, step, constrain, log, checkpoint."""

from __future__ import annotations

import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from psdr_jit.errors import OptionError, StalledWarning, ZeroDerivativeWarning
from psdr_jit.inverse import checkpoint as checkpoints
from psdr_jit.inverse.checkpoint import Checkpoint
from psdr_jit.inverse.journal import Journal
from psdr_jit.inverse.problem import Latents, Problem
from psdr_jit.inverse.variables import like, numbers

#: Losses that are averaged before a run counts as diverging, or a state as the best: one alone may be noise.
RECENT = 5

FINISHED, OUT_OF_TIME, DIVERGED, INTERRUPTED = "finished", "out of time", "diverged", "interrupted"


@dataclass
class Result:
    """What became of a run. The scene is left at `latents`."""

    status: str  # "finished", "out of time", "diverged" or "interrupted"
    iterations: int  # that have been done, in all runs together
    seconds: float  # of all runs together, without reading and checking the problem
    losses: list[float]  # by iteration of this run, before its step
    latents: Latents  # detached
    offsets: dict[str, dict[str, float]]  # from the scene's own values, now ...
    start_offsets: dict[str, dict[str, float]]  # ... and at the start
    not_written: list[str] = field(default_factory=list)  # what the disk did not take

    @property
    def loss(self) -> float:
        """Mean of the last few losses."""
        return float(np.mean(self.losses[-RECENT:])) if self.losses else float("nan")


@dataclass
class _State:
    """What changes from iteration to iteration."""

    latents: Latents
    optimisers: dict[str, Any]  # by parameter
    best: Latents
    best_loss: float = float("inf")
    iteration: int = 0
    seconds: float = 0.0  # of runs before this one
    first_losses: list[float] = field(default_factory=list)
    recent: deque = field(default_factory=lambda: deque(maxlen=RECENT))  # losses
    passed: deque = field(default_factory=lambda: deque(maxlen=RECENT))  # (loss, latents) of the same iterations
    without_gradient: dict[str, int] = field(default_factory=dict)
    norms: dict[str, float] = field(default_factory=dict)  # of the latest gradient
    began: float = field(default_factory=time.perf_counter)

    def clock(self) -> float:
        """Seconds of all runs together."""
        return self.seconds + time.perf_counter() - self.began


def run(
    problem: Problem,
    folder: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> Result:
    """Optimise; with a `folder`, log there, checkpoint, and `resume` from it. See `psdr_jit.optimize`."""
    state = _begin(problem)
    start_offsets = problem.offsets(problem.start())
    if resume and folder is None:
        raise OptionError("resuming needs the folder of the run that was interrupted")
    if resume:
        _restore(problem, state, checkpoints.load(folder / "checkpoint.npz", problem.fingerprint()))
    journal = Journal(folder, problem, keep=state.iteration)
    journal.picture(problem, problem.start())
    losses: list[float] = []
    status = _loop(problem, state, journal, losses, progress)
    if status == DIVERGED:
        state.latents = state.best
    else:
        journal.keep(_checkpoint(problem, state))
    found = _detached(state.latents)
    problem.apply(found)
    result = Result(
        status,
        state.iteration,
        state.clock(),
        losses,
        found,
        problem.offsets(found),
        start_offsets,
        journal.not_written,
    )
    if status != INTERRUPTED:
        journal.finish(problem, result)
    return result


class Stepper:
    """The loop taken apart: one iteration at a time, without files. For measurements and loops of one's own."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._state = _begin(problem)
        self._journal = Journal(None, problem, keep=0)

    def step(self) -> float:
        """One iteration; the loss before its step."""
        loss = _iterate(self.problem, self._state, self._journal)
        self._state.iteration += 1
        return loss

    @property
    def latents(self) -> Latents:
        """As they are now, detached."""
        return _detached(self._state.latents)


def _loop(problem: Problem, state: _State, journal: Journal, losses: list[float], progress: Any) -> str:
    """Iterate until there is a reason to stop, and return it."""
    total, limit = problem.settings.iterations, problem.settings.max_seconds
    with _interruptible() as interrupted:
        while state.iteration < total:
            if interrupted:
                return INTERRUPTED
            if limit is not None and state.clock() > limit:
                return OUT_OF_TIME
            losses.append(_iterate(problem, state, journal))
            if _diverges(problem, state, losses[-1]):
                warnings.warn(_about_divergence(state, losses[-1]), RuntimeWarning, stacklevel=4)
                return DIVERGED
            state.iteration += 1
            if state.iteration % problem.settings.checkpoint_every == 0:
                journal.keep(_checkpoint(problem, state))
            if progress is not None:
                each = (time.perf_counter() - state.began) / len(losses)
                left = each * (total - state.iteration)
                norm = " ".join(f"{value:.1e}" for value in state.norms.values())
                note = f"loss {losses[-1]:.3e}  |gradient| {norm}  {each:.2f} s/it  {left:.0f} s left"
                progress(state.iteration, total, note)
    return FINISHED


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Ctrl-C fills the list instead of stopping between two variables of a step; pressed again, it stops at once."""
    seen: list[int] = []

    def note(number: int, frame: Any) -> None:
        seen.append(number)
        signal.signal(signal.SIGINT, before)

    if threading.current_thread() is not threading.main_thread():  # only that one receives signals
        yield seen
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)


def _begin(problem: Problem) -> _State:
    latents = problem.start()
    optimisers = {}
    for name, variable in problem.variables.items():
        opt = optimisers[name] = problem.settings.make_optimizer(variable.uniform)
        for latent, value in latents[name].items():
            opt[latent] = value
            latents[name][latent] = opt[latent]
        checkpoints.make_opaque(opt)  # counters start as literals, which would compile other kernels in the first step
    return _State(latents, optimisers, best=_detached(latents))


def _restore(problem: Problem, state: _State, stored: Checkpoint) -> None:
    checkpoints.restore_optimisers(state.optimisers, stored.arrays)
    for name, latents in state.latents.items():
        for latent in latents:
            latents[latent] = state.optimisers[name][latent]
            state.best[name][latent] = like(dr.detach(latents[latent]), stored.best[f"{name}/{latent}"])
    state.iteration, state.seconds, state.best_loss = stored.iteration, stored.seconds, stored.best_loss
    state.first_losses = stored.arrays["losses/first"].tolist()
    state.recent.extend(stored.arrays["losses/recent"].tolist())


def _checkpoint(problem: Problem, state: _State) -> Checkpoint:
    arrays = checkpoints.optimiser_arrays(state.optimisers)
    arrays |= {"losses/first": np.array(state.first_losses), "losses/recent": np.array(list(state.recent))}
    best = {f"{name}/{latent}": numbers(v) for name, found in state.best.items() for latent, v in found.items()}
    return Checkpoint(state.iteration, problem.fingerprint(), arrays, best, state.best_loss,
                      state.clock())  # fmt: skip


def _iterate(problem: Problem, state: _State, journal: Journal) -> float:
    """One step of every optimiser; the loss before it."""
    start = time.perf_counter()
    rate = problem.settings.decay ** (state.iteration / problem.settings.iterations)
    before = _detached(state.latents)
    problem.apply(state.latents)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ZeroDerivativeWarning)  # said once it has lasted, with the variable's name
        loss, images = problem.evaluate(state.iteration)
    state.recent.append(loss)
    state.passed.append((loss, before))
    if len(state.first_losses) < RECENT:
        state.first_losses.append(loss)
    if np.mean(state.recent) < state.best_loss and len(state.recent) == RECENT:
        state.best, state.best_loss = min(state.passed, key=lambda entry: entry[0])[1], float(np.mean(state.recent))
    norms = state.norms = {}
    for name, variable in problem.variables.items():
        opt = state.optimisers[name]
        norms[name] = _norm([dr.grad(opt[latent]) for latent in state.latents[name]])
        _watch(problem, state, name, norms[name])
        if np.isfinite(loss) and np.isfinite(norms[name]):
            opt.set_learning_rate({latent: rate * lr for latent, lr in variable.learning_rates.items()})
            opt.step()
        for latent, value in variable.constrained({k: dr.detach(opt[k]) for k in state.latents[name]}).items():
            opt[latent] = value
            state.latents[name][latent] = opt[latent]
    journal.step(state.iteration, loss, norms, time.perf_counter() - start, problem.chosen(state.iteration), rate,
                 problem.offsets(before))  # fmt: skip
    every = problem.settings.snapshot_every
    if every and state.iteration % every == 0:
        journal.snapshot(state.iteration, problem, images)
    return loss


def _norm(grads: list[Any]) -> float:
    return float(np.sqrt(sum(np.sum(np.square(numbers(g))) for g in grads)))


def _watch(problem: Problem, state: _State, name: str, norm: float) -> None:
    """Warn once if a variable has had no gradient for a while, with the reason that the plan gives."""
    count = state.without_gradient[name] = state.without_gradient.get(name, 0) + 1 if norm == 0 else 0
    if count == problem.settings.stalled_after:
        plan = getattr(problem.integrator, "plan", None)
        terms = (
            [f"{t.name} {'runs' if t.runs else 'is out'}: {t.reason}" for t in plan.terms] if plan is not None else []
        )
        reason = f"; the latest plan: {'; '.join(terms)}" if terms else ""
        said = (
            f"the loss has not depended on '{name}' for {count} iterations (its gradient is 0): is it seen, or does it "
            f"cast light or shadow on what is seen?{reason}"
        )
        warnings.warn(said, StalledWarning, stacklevel=6)


def _diverges(problem: Problem, state: _State, loss: float) -> bool:
    if not np.isfinite(loss):
        return True
    if len(state.recent) < RECENT or state.iteration < 2 * RECENT:
        return False
    return np.mean(state.recent) > problem.settings.diverged_factor * abs(min(state.first_losses))


def _about_divergence(state: _State, loss: float) -> str:
    known = f"the best state (loss {state.best_loss:.3e})" if np.isfinite(state.best_loss) else "the start"
    return (
        f"the loss diverged at iteration {state.iteration} (now {loss:.3e}, at first "
        f"{min(state.first_losses):.3e}): stopped, {known} is kept; lower the learning rates, or raise spp"
    )


def _detached(latents: Latents) -> Latents:
    return {name: {k: type(v)(dr.detach(v)) for k, v in found.items()} for name, found in latents.items()}
