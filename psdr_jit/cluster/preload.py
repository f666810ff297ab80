"""Loaded by the local workers as they start, also by those that replace dead ones."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Ctrl-C reaches every process of a terminal: it is for the one that asked for the work, which ends in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
