"""What outlives a call, by typed slots: each room declares what it keeps, nobody knows all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Slot(Generic[T]):
    """A place in a `Memory`, declared once by the module that uses it: `KEPT: Slot[dict[str, X]] = Slot(dict)`."""

    make: Callable[[], T]  # what is there before anything has been kept


class Memory:
    """Values by slot. An integrator has one that outlives its calls; a render call has one that its terms share."""

    def __init__(self):
        self._kept: dict[Slot[Any], Any] = {}

    def __getitem__(self, slot: Slot[T]) -> T:
        if slot not in self._kept:
            self._kept[slot] = slot.make()
        return self._kept[slot]

    def __setitem__(self, slot: Slot[T], value: T) -> None:
        self._kept[slot] = value
