"""Units of work, handed out by Dask, their results in the order in which they were asked for.

Whoever dies on the way: Dask gives the unit to another worker, and as a unit's result depends on nothing but the unit,
it is the same. What cannot be mended so is a typed error.
"""

from __future__ import annotations

import gc
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from typing import Any

import drjit as dr
import mitsuba as mi

from psdr_jit.cluster import worker
from psdr_jit.cluster.source import Parcel, SceneFile, parcel_of
from psdr_jit.cluster.values import Values, changed, digests
from psdr_jit.cluster.worker import Place
from psdr_jit.errors import ClusterError, OptionError, PsdrError, SetupError
from psdr_jit.scene.names import traverse

LOOPBACK = "127.0.0.1"
PATIENCE = 60.0  # seconds to wait for a first worker
SMALL = 1 << 20  # bytes of a scene's state that travel with every unit of work
MESSAGE = 1 << 23  # bytes of units that are handed out at once; of more Dask warns

#: Digests of the parameters of files as they are, by variant and digest of the file.
_AS_LOADED: dict[tuple[str, str], dict[str, bytes]] = {}


def require_dask() -> Any:
    """The module `distributed`. Raises `SetupError` where it is not installed."""
    try:
        import distributed
    except ImportError as error:
        raise SetupError(
            "several machines or processes need Dask, which is not installed: pip install 'distributed>=2024.1'"
        ) from error
    return distributed


@contextmanager
def local(workers: int) -> Iterator[Any]:
    """A Dask client of so many processes on this machine, which share its cores; reachable from it only."""
    distributed = require_dask()
    if workers < 1:
        raise OptionError(f"workers = {workers}: expected one or more")
    cluster = distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host=LOOPBACK, dashboard_address=f"{LOOPBACK}:0",
        silence_logs=50,  # what goes wrong is raised
        preload=["psdr_jit.cluster.preload"],
        env={worker.THREADS: str(max(worker.LEAST_THREADS, dr.thread_count() // workers))},
    )  # fmt: skip
    with cluster, distributed.Client(cluster) as client:
        yield client


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A Dask client of a scheduler that is there. Raises `ClusterError` if it does not answer."""
    distributed = require_dask()
    try:
        client = distributed.Client(address)
    except (OSError, ValueError) as error:  # ValueError: no address at all
        raise ClusterError(f"no scheduler answers at '{address}' ({error}): start one with 'dask scheduler', "
                           "and give the address that it prints, such as tcp://10.0.0.1:8786") from error  # fmt: skip
    except TypeError as error:  # so says Dask of a TLS address without a certificate
        raise ClusterError(
            f"'{address}' wants a certificate for TLS: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, __CLIENT__CERT and "
            "__CLIENT__KEY (psdr_jit/cluster/README.md)"
        ) from error
    with client:
        yield client


class Engine:
    """A client and the scene that its workers are to have, as it is now. `at_once`: scenes that they should keep."""

    def __init__(self, client: Any, scene: Any, source: SceneFile | str | None, at_once: int = 1) -> None:
        if not isinstance(client, require_dask().Client):
            raise OptionError(f"client = {client!r:.60}: expected a distributed.Client")
        if source is None:
            raise OptionError(
                "workers must know where the scene is from: give source=psdr_jit.SceneFile('scene.xml', {'res': 64}), "
                "with the defaults that it was loaded with"
            )
        self.client = client
        parcel = parcel_of(SceneFile(source) if isinstance(source, str) else source)
        self._at_first = Place(mi.variant(), parcel, _values(scene, parcel), worker.versions(), at_once)
        self._said: set[str] = set()
        self._wait_for_workers()
        self.update({})

    def update(self, values: Values) -> None:
        """Let units see these values of parameters from now on."""
        place = replace(self._at_first, values={**self._at_first.values, **values})
        # With every unit, or, if large, once to each worker: as a task, not as scattered data, since Dask makes it anew
        # where the worker that has it dies.
        small = len(pickle.dumps(place)) <= SMALL
        self._place = place if small else self.client.submit(_same, place, pure=False)

    @property
    def workers(self) -> int:
        """How many there are now."""
        return max(1, len(self._addresses()))

    def ordered(self, function: Callable[..., Any], units: Iterable[tuple]) -> Iterator[Any]:
        """`function(held, *unit)` for every unit, in order. Raises typed errors, of units those of the worker."""
        return together(function, [(self, unit) for unit in units])

    def hand_out(self, function: Callable[..., Any], units: Sequence[tuple]) -> list[Any]:
        """The futures of units of work, in order."""
        with self._named():
            if isinstance(self._place, Place):
                return self._map(function, units)
            # Dask would give all units to the worker that has the state, and let others take of them after a while.
            addresses = self._addresses()
            futures: list[Any] = [None] * len(units)
            for k, address in enumerate(addresses[: len(units)]):
                share = slice(k, None, len(addresses))
                futures[share] = self._map(function, units[share], workers=[address], allow_other_workers=True)
            return futures

    def _map(self, function: Callable[..., Any], units: Sequence[tuple], **where: Any) -> list[Any]:
        """In as few messages as the sizes of units allow."""
        count = len(units)
        at_once = max(2, MESSAGE // len(pickle.dumps(units[0])))  # 1 would mean all to Dask
        columns = [list(column) for column in zip(*units, strict=True)]
        return self.client.map(worker.work, [function] * count, [self._place] * count, *columns, pure=False,
                               batch_size=at_once, **where)  # fmt: skip

    def _addresses(self) -> list[str]:
        return list(self.client.scheduler_info(n_workers=-1)["workers"])

    def finished(self, futures: Sequence[Any]) -> list[Any]:
        """The results of the first future, once it is there, and of those after it that are there by then."""
        from distributed import wait

        with self._named():
            wait(futures[0])
            results = self.client.gather(list(takewhile(lambda future: future.done(), futures)))
        for _, said in results:
            self._warn(said)
        return [result for result, _ in results]

    def forget(self, futures: Sequence[Any]) -> None:
        """What nobody waits for any more."""
        if futures and self.client.status == "running":
            self.client.cancel(list(futures))

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Turn what Dask raises into typed errors."""
        from distributed.scheduler import KilledWorker

        try:
            yield
        except PsdrError:
            raise
        except KilledWorker as error:
            count, last = error.allowed_failures + 1, error.last_worker.address
            raise ClusterError(
                f"a unit of work ended {count} workers, at last '{last}': does it need more memory than they have? "
                "Lower spp or record_mib, or give them more"
            ) from error
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterError(
                f"the scheduler at '{self.client.scheduler.address}' is gone ({type(error).__name__}): start it anew "
                "and run this again"
            ) from error
        except ModuleNotFoundError as error:
            said = f"a worker lacks the package '{error.name}': install the same on all machines"
            raise ClusterError(said) from error

    def _warn(self, said: Iterable[tuple[type[Warning], str]]) -> None:
        """Say here, once, what workers have said."""
        for category, text in said:
            if text not in self._said:
                self._said.add(text)
                warnings.warn(text, category, stacklevel=4)

    def _wait_for_workers(self) -> None:
        try:
            self.client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            raise ClusterError(
                f"the scheduler at '{self.client.scheduler.address}' has no workers after {PATIENCE:.0f} s: start some "
                "with 'dask worker ADDRESS --nthreads 1'"
            ) from error


def together(function: Callable[..., Any], units: Iterable[tuple[Engine, tuple]]) -> Iterator[Any]:
    """`function(held, *unit)` for units with scenes of their own, all handed out at once; see `Engine.ordered`."""
    units = list(units)
    handed = {}
    for engine in dict.fromkeys(engine for engine, _ in units):
        handed[engine] = iter(engine.hand_out(function, [unit for own, unit in units if own is engine]))
    left = [(engine, next(handed[engine])) for engine, _ in units]
    try:
        while left:
            engine = left[0][0]
            results = engine.finished([future for _, future in takewhile(lambda pair: pair[0] is engine, left)])
            del left[: len(results)]  # workers may forget them
            yield from results
    finally:
        for engine in handed:
            engine.forget([future for own, future in left if own is engine])


def _same(place: Place) -> Place:
    return place


def _values(scene: Any, parcel: Parcel) -> Any:
    """What in `scene` differs from its file. Raises `OptionError` if it is another scene altogether."""
    key = (mi.variant(), parcel.digest)
    if key not in _AS_LOADED:
        loaded = parcel.load()
        _AS_LOADED[key] = digests(traverse(loaded))
        del loaded
        gc.collect()  # see worker.hold
    params, before = traverse(scene), _AS_LOADED[key]
    other = sorted(digests(params).keys() ^ before.keys())
    if other:
        raise OptionError(
            f"the scene is not the one in '{parcel.path}': only one of them has '{other[0]}'; name the file and the "
            "defaults that it was loaded with"
        )
    return changed(params, before)
