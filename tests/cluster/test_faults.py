"""Workers that are late, too small, or not there: work waits, or a typed error says what to do."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from clusters import BOX

import psdr_jit
from psdr_jit.cluster import engine
from psdr_jit.errors import ClusterError

pytestmark = pytest.mark.slow

MOVE = dict(direction=(1, 0, 0), spp=4, seeds=2)
ROUNDING = 1e-5


@pytest.fixture
def nobody() -> Iterator[Any]:
    """A scheduler on this machine without workers."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=0, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
                                  silence_logs=50) as cluster:  # fmt: skip
        yield cluster


def test_workers_that_are_late_are_waited_for(scene, source, nobody):
    from distributed import Client

    own = psdr_jit.gradient(scene, BOX, **MOVE)
    with Client(nobody) as client:
        late = threading.Timer(2.0, nobody.scale, [1])
        late.start()
        found = psdr_jit.gradient(scene, BOX, **MOVE, client=client, source=source)
        late.join()
    assert np.abs(found.total - own.total).max() <= ROUNDING * np.abs(own.total).max() > 0


def test_workers_that_never_come_are_missed(scene, source, nobody, monkeypatch):
    from distributed import Client

    monkeypatch.setattr(engine, "PATIENCE", 1.0)
    with Client(nobody) as client, pytest.raises(ClusterError, match="has no workers after 1 s: start some with"):
        psdr_jit.gradient(scene, BOX, **MOVE, client=client, source=source)


def test_work_that_ends_every_worker_is_not_repeated_for_ever(scene, source, two):
    """What the system does to a process that has taken all memory, to whichever worker gets the unit."""

    def too_much(held: Any) -> None:
        time.sleep(3.0)  # it takes a while; Dask does not replace workers that die as they start
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ClusterError, match=r"ended \d+ workers, at last 'tcp://.*more memory.*Lower spp"):
        list(engine.Engine(two, scene, source).ordered(too_much, [()]))
    two.wait_for_workers(2, timeout=240)
    assert psdr_jit.gradient(scene, BOX, **MOVE, client=two, source=source).total.any(), "others go on"


def test_a_scheduler_that_does_not_answer_is_named():
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "2s"}):
        with pytest.raises(ClusterError, match="no scheduler answers at 'tcp://127.0.0.1:1'.*dask scheduler"):
            with engine.connected("tcp://127.0.0.1:1"):
                pass
