"""What outlives a call, by typed slots: each room declares what it keeps, nobody knows all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

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


def same_contents(kept: list[Any], arrays: list[Any]) -> bool:
    """Do these flat JIT arrays, one by one, hold what the kept ones do? At once where they are those that were kept.

    For what takes longer to make than to compare: parameters that are assigned anew in every call, to attach them,
    are other arrays of the same content. Compared on the host, so that no kernel is met in the second call only.
    """
    if [dr.width(a) for a in kept] != [dr.width(b) for b in arrays]:
        return False
    changed = [(a, b) for a, b in zip(kept, arrays, strict=True) if a.index != b.index]
    return all(np.array_equal(np.array(a), np.array(b)) for a, b in changed)


def while_unchanged(kept: dict[K, tuple[list[Any], T]], key: K, arrays: list[Any], make: Callable[[], T]) -> T:
    """What `make()` returned for `key`, made anew once one of the arrays it is made from has been replaced."""
    arrays = [dr.detach(array) for array in arrays]
    if key not in kept or not same_arrays(kept[key][0], arrays):
        kept[key] = (arrays, make())
    return kept[key][1]
