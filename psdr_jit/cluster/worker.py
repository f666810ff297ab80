"""What runs on a worker: it keeps a scene, puts it where the caller's stands, and does a unit of work with it.

No more scenes than the caller works with at once: Dr.Jit's virtual calls reach every one that is alive, which makes
kernels larger. Gradients are enabled in one of them at a time, and not any more when a unit is done.
"""

from __future__ import annotations

import gc
import os
import platform
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import psdr_jit
from psdr_jit.cluster.source import Parcel, here
from psdr_jit.cluster.values import Values, digest_of, from_numpy, to_numpy
from psdr_jit.errors import ClusterError, PsdrError
from psdr_jit.scene.io import use_variant
from psdr_jit.scene.names import traverse

LEAST_THREADS = 2  # Mitsuba waits for ever with one that was asked for
THREADS = "PSDR_THREADS"  # environment variable of workers: threads of Dr.Jit, all cores unless it is set


@dataclass(frozen=True)
class Place:
    """A scene as it is at the caller's: variant, file, and parameters that differ from the file."""

    variant: str
    parcel: Parcel
    values: Values = field(repr=False)
    versions: dict[str, str]
    at_once: int = 1  # scenes that the caller works with


@dataclass(eq=False)
class Held:
    """A scene that this process has."""

    variant: str
    digest: str
    scene: Any
    originals: Values  # of what was changed
    now: dict[str, bytes]  # digests of what was changed
    kept: dict[Any, Any]  # whatever units want to find again, such as integrators


_HELD: list[Held] = []


def versions() -> dict[str, str]:
    """What has to be the same everywhere, or results are not."""
    return {"psdr_jit": psdr_jit.__version__, "mitsuba": mi.__version__, "drjit": dr.__version__,
            "numpy": np.__version__.split(".")[0], "python": ".".join(platform.python_version_tuple()[:2])}  # fmt: skip


def work(function: Callable[..., Any], place: Place, *args: Any) -> tuple[Any, list[tuple[type[Warning], str]]]:
    """`function(held, *args)` on this worker, and what it warned of; its typed errors name the machine."""
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            require_versions(place.versions)
            return function(hold(place), *args), [(warning.category, str(warning.message)) for warning in said]
    except PsdrError as error:
        raise type(error)(f"on machine '{here()}': {error}") from error


def require_versions(wanted: dict[str, str]) -> None:
    """Raises `ClusterError` unless this process has the packages of the caller."""
    own = versions()
    off = [f"{name} {own[name]} instead of {version}" for name, version in wanted.items() if own[name] != version]
    if off:
        raise ClusterError(f"there is {', '.join(off)}: install the same versions on all machines")


def hold(place: Place) -> Held:
    """The scene, loaded if it is not held, with the parameters of `place`."""
    if _let_go(place):
        gc.collect()  # Dr.Jit's virtual calls reach every scene that is alive
    if not _HELD or not _is(_HELD[-1], place):
        if mi.variant() != place.variant:
            use_variant(place.variant)
        _share_cores()
        _HELD.append(Held(place.variant, place.parcel.digest, place.parcel.load(), {}, {}, {}))
    held = _HELD[-1]
    _apply(held, place.values)
    return held


def _is(held: Held, place: Place) -> bool:
    return (held.variant, held.digest) == (place.variant, place.parcel.digest)


def _let_go(place: Place) -> bool:
    """Put the scene of `place` last, if it is held, and forget the oldest ones that are too many: were there any?"""
    own = [held for held in _HELD if _is(held, place)]
    others = [held for held in _HELD if held.variant == place.variant and held not in own]
    before = len(_HELD)
    _HELD[:] = [*others[max(0, len(others) - place.at_once + 1) :], *own]
    return len(_HELD) < before


def _apply(held: Held, values: Values) -> None:
    """Put parameters in; what was changed before and is not any more gets its own value back."""
    wanted = {**held.originals, **values}
    stale = {name: v for name, v in wanted.items() if held.now.get(name) != digest_of(v)}
    if not stale:
        return
    params = traverse(held.scene)
    for name, numbers in stale.items():
        held.originals.setdefault(name, to_numpy(params[name]))
        params[name] = from_numpy(params[name], numbers)
        params.set_dirty(name)
        held.now[name] = digest_of(numbers)
    params.update()


def _share_cores() -> None:
    """Use as many threads as this worker was given, where several of them share a machine."""
    wanted = os.environ.get(THREADS, "")
    if wanted.isdigit():
        dr.set_thread_count(max(LEAST_THREADS, int(wanted)))
