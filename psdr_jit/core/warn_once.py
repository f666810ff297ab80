"""Warnings that would repeat with every sample of a loop, said once."""

from __future__ import annotations

import re
import warnings

from .memory import Memory, Slot

#: What an integrator has warned about.
SAID: Slot[set[str]] = Slot(set)


def warn_once(message: str, category: type[Warning], memory: Memory | None) -> None:
    """Warn unless `memory` knows the message. `None`: warn always.

    Numbers outside of quotes do not count: they change as an optimisation goes on.
    """
    key = re.sub(r"('[^']*')|\d[\d.e+-]*", r"\1", message)
    known = set() if memory is None else memory[SAID]
    if key not in known:
        known.add(key)
        warnings.warn(message, category, stacklevel=3)
