"""What outlives a call, by typed slots: each room declares what it keeps, nobody knows all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import drjit as dr
import mitsuba as mi

from .surface_code import registry_index

K = TypeVar("K")
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

    def once(self, slot: Slot[T], make: Callable[[], T]) -> T:
        """What is kept there, made by whoever asks first: for what takes more to make than a slot knows."""
        if slot not in self._kept:
            self._kept[slot] = make()
        return self._kept[slot]


def key_of(shape: mi.Shape) -> str | int:
    """What stands for a shape in a memory: its id or, as files leave many without one, a number of its own."""
    return shape.id() or registry_index(shape)


def same_arrays(kept: list[Any], arrays: list[Any]) -> bool:
    """Are these JIT arrays, one by one, those that were kept?

    A variable that is kept keeps its index, and whatever writes to a parameter replaces its variable by another.
    Values are not compared, nor derivatives.
    """
    return [a.index for a in kept] == [a.index for a in arrays]


def while_unchanged(
    kept: dict[K, tuple[list[Any], T]], key: K, arrays: list[Any], make: Callable[[], T], most: int | None = None
) -> T:
    """What `make()` returned for `key`, made anew once one of the arrays it is made from has been replaced.

    `most`: how many keys are kept, the newest; None for keys that cannot become many.
    """
    arrays = [dr.detach(array) for array in arrays]
    if key not in kept or not same_arrays(kept[key][0], arrays):
        kept[key] = (arrays, make())
    found = kept[key][1]
    while most is not None and len(kept) > most:
        del kept[next(iter(kept))]
    return found
