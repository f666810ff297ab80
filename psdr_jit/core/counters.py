"""What is dropped is counted: a NaN masked in silence would be a defect."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi


class Counter:
    """Counter of dropped samples. Lives on an integrator, reads as an `int`, costs no synchronisation until then."""

    def __init__(self):
        self._count = mi.UInt32(0)

    def keep_finite(self, value: mi.Spectrum) -> mi.Spectrum:
        """`value` with 0 in lanes where any component is NaN or infinite; those are counted. Detached, evaluated."""
        sound = dr.all(dr.isfinite(value))
        kept = dr.select(sound, value, 0)
        dr.eval(kept, sound)  # at once: the sum alone would run whatever made `value`, and its use once more
        self.count(~sound)
        return kept

    def count(self, dropped: mi.Bool) -> None:
        """Count the lanes set in `dropped`."""
        number = dr.select(dropped, mi.UInt32(1), 0)
        dr.eval(number)
        self._count += dr.sum(number)
        dr.schedule(self._count)

    def __repr__(self) -> str:
        return str(int(self))

    def __int__(self) -> int:
        return int(self._count[0])

    def clear(self) -> None:
        self._count = mi.UInt32(0)


@dataclass(frozen=True)
class Counters:
    """Of one integrator, over all its calls."""

    rejected: Counter = field(default_factory=Counter)  # samples that were not finite
    grazing: Counter = field(default_factory=Counter)  # paths that end where they meet a surface edge-on
