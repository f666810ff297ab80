"""How far a computation is: a bar in a terminal, or in a notebook.

Rich draws the bar of terminals. Its bar for notebooks needs ipywidgets; a displayed object that is replaced needs
nothing, so that one is ours.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from psdr_jit.core import markup

PATIENCE = 2.0  # seconds before a bar appears
REDRAW = 0.2    # seconds between two states of a bar in a notebook

Report = Callable[..., None]
"""`report(done, total, note="")`."""


def in_notebook() -> bool:
    """Does this process compute for a notebook? IPython in a terminal is none."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


@contextmanager
def reporting(label: str, wanted: Any, adapt: Callable[[Report], Callable] | None = None) -> Iterator[Callable | None]:
    """What a computation is to call: `wanted` if that is a function, a bar if it is True, nothing if it is False.

    None: a bar in notebooks. `adapt` makes of `report` what the computation calls.
    """
    if callable(wanted) or wanted is False or (wanted is None and not in_notebook()):
        yield wanted or None
        return
    with bar(label) as report:
        yield report if adapt is None else adapt(report)


@contextmanager
def bar(label: str, quiet: bool = False) -> Iterator[Report]:
    """Yields `report(done, total, note)`. Appears only if the work takes a while; in a terminal on stderr."""
    start = time.perf_counter()
    shown = _NotebookBar(label) if in_notebook() else _TerminalBar(label)
    started = False

    def report(done: float, total: float, note: str = "") -> None:
        nonlocal started
        seconds = time.perf_counter() - start
        if not quiet and not started and seconds > PATIENCE:
            shown.start()
            started = True
        shown.update(min(1.0, done / total), note, seconds)

    try:
        yield report
    finally:
        if started:
            shown.stop()


class _TerminalBar:
    def __init__(self, label: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(file=sys.stderr)
        columns = (TextColumn(label), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
                   TextColumn("{task.fields[note]}"))  # fmt: skip
        self._bar = Progress(*columns, console=console, transient=not console.is_terminal)
        self._task = self._bar.add_task(label, total=1.0, note="")

    def start(self) -> None:
        self._bar.start()

    def update(self, share: float, note: str, seconds: float) -> None:
        self._bar.update(self._task, completed=share, note=note)

    def stop(self) -> None:
        self._bar.stop()


class _NotebookBar:
    """An object that is displayed once and then replaced by itself in its next state."""

    def __init__(self, label: str) -> None:
        self.label, self.share, self.note, self.seconds = label, 0.0, "", 0.0
        self._handle: Any = None
        self._drawn = 0.0

    def start(self) -> None:
        from IPython.display import display

        self._handle = display(self, display_id=True)

    def update(self, share: float, note: str, seconds: float) -> None:
        self.share, self.note, self.seconds = share, note, seconds
        if self._handle is not None and seconds - self._drawn > REDRAW:
            self._drawn = seconds
            self._handle.update(self)

    def stop(self) -> None:
        self._handle.update(self)

    def _repr_html_(self) -> str:
        return markup.bar(self.label, self.share, f"{self.share:.0%}, {self.seconds:.0f} s", self.note)

    def __repr__(self) -> str:
        return f"{self.label} {self.share:.0%}, {self.seconds:.0f} s {self.note}".rstrip()
