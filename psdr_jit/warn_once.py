"""Warnings that would repeat with every sample of a loop, said once."""

from __future__ import annotations

import re
import warnings


def warn_once(message: str, category: type[Warning], said: dict | None) -> None:
    """Warn unless `said`, kept by the caller, knows the message. `None`: warn always.

    Numbers outside of quotes do not count: they change as an optimisation goes on.
    """
    key = re.sub(r"('[^']*')|\d[\d.e+-]*", r"\1", message)
    known = set() if said is None else said.setdefault("warnings", set())
    if key not in known:
        known.add(key)
        warnings.warn(message, category, stacklevel=3)
