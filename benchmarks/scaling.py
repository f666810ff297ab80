"""How many workers a step of an optimisation from many views can use: a cluster of workers that only wait.

    python -m benchmarks.scaling                        (six minutes; append to benchmarks/results/scaling.jsonl)
    python -m benchmarks.scaling --workers 64 --out -   (print the row instead)
    python -m benchmarks.scaling --local 2              (real work by so many processes here, beside this one alone)

64 units of work of 2 s, one a view, are handed out by Dask to 1, 2, 4, ... 64 workers, each with what a unit of an
optimisation has: the state of its scene and an image there, an image back. Efficiency is the waiting that there is to
do, divided by workers and the time it took. Workers, scheduler and caller are threads of this process which talk by
TCP, so that what is not waiting shares the cores, and one lock, of this machine: machines of their own do not do worse.
What workers do for themselves all the time, such as watching their memory, is turned down for this reason. Beside the
efficiency there is the processor time of a run, which other load on the machine does not change as much.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import psdr_jit
from benchmarks import rows
from psdr_jit.cluster.engine import LOOPBACK, Engine, local, require_dask
from psdr_jit.scene import io as scene_io

BENCH = "scaling"
SCENE, DEFAULTS = "emissive_card.xml", {"res": 16}
WORKERS = (1, 2, 4, 8, 16, 32, 64)
VIEWS, SECONDS, RES = 64, 2.0, 64
WARM_UP = 3  # runs of local workers, until each has met each kind of unit
RUNS, LONG = 5, 30.0  # runs per number of workers; what takes longer [s] runs once
QUIET_WORKERS = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "10s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
}  # 64 of each in one process would take half a core


def waiting_unit(held: Any, seconds: float, image: np.ndarray) -> np.ndarray:
    """On a worker: what a view costs, without the cost."""
    time.sleep(seconds)
    return image


@contextmanager
def simulated(workers: int) -> Iterator[Any]:
    """A Dask client of workers in this process."""
    distributed = require_dask()
    import dask  # comes with it

    with (
        dask.config.set(QUIET_WORKERS),
        distributed.LocalCluster(n_workers=workers, threads_per_worker=1, processes=False, host=LOOPBACK,
                                 protocol="tcp://", dashboard_address=f"{LOOPBACK}:0", silence_logs=50) as cluster,
        distributed.Client(cluster) as client,
    ):  # fmt: skip
        client.wait_for_workers(workers)
        yield client


def measure(workers: int, views: int, seconds: float, res: int) -> tuple[list[float], list[float]]:
    """Efficiency, and seconds of processor time, of each run."""
    path = str(scene_io.shipped_scene(SCENE))
    scene = scene_io.load_scene(path, **DEFAULTS)
    images = [np.full((res, res, 3), k, np.float32) for k in range(views)]
    ideal = seconds * views / workers
    found, busy = [], []
    with simulated(workers) as client:
        engine = Engine(client, scene, psdr_jit.SceneFile(path, DEFAULTS))
        list(engine.ordered(waiting_unit, [(0.0, images[0])]))  # threads of one process: one of them loads the scene
        list(engine.ordered(waiting_unit, [(0.0, image) for image in images]))
        for _ in range(1 if ideal > LONG else RUNS):
            start, worked = time.perf_counter(), time.process_time()
            results = list(engine.ordered(waiting_unit, [(seconds, image) for image in images]))
            found.append(ideal / (time.perf_counter() - start))
            busy.append(time.process_time() - worked)
            assert all(np.array_equal(a, b) for a, b in zip(results, images, strict=True)), "results out of order"
    return found, busy


def row(workers: list[int], views: int, seconds: float, res: int) -> dict[str, Any]:
    """The whole curve: efficiency and processor time by number of workers."""
    curve, busy = {}, {}
    for count in workers:
        curve[str(count)], busy[str(count)] = map(rows.summary, measure(count, views, seconds, res))
        print(f"{count} workers: efficiency {curve[str(count)]['median']:.3f}", file=sys.stderr, flush=True)
    return {"bench": BENCH, "case": f"{views} views", "method": f"units of {seconds:g} s", "seeds": RUNS,
            "settings": {"views": views, "seconds": seconds, "res": res}, "efficiency": curve,
            "cpu_seconds": busy}  # fmt: skip


def local_row(workers: int, res: int = 128, spp: int = 32, seeds: int = 8) -> dict[str, Any]:
    """Derivatives by processes of this machine beside this process, which rests meanwhile: ratio of throughputs.

    The two take turns; their first runs, which load scenes and kernels, are dropped. So is the start of the workers,
    which a run of minutes does not see.
    """
    path, defaults = str(scene_io.shipped_scene("cbox.xml")), {"res": res, "max_depth": 4}
    scene, source = scene_io.load_scene(path, **defaults), psdr_jit.SceneFile(path, defaults)
    times: dict[str, list[float]] = {"alone": [], "workers": []}
    with local(workers) as client:
        who = {"alone": {}, "workers": {"client": client, "source": source}}
        for turn in range(WARM_UP + RUNS):
            for name, given in who.items():
                start = time.perf_counter()
                psdr_jit.gradient(scene, "small-box.vertex_positions", (1, 0, 0), spp=spp, seeds=seeds, **given)
                if turn >= WARM_UP:
                    times[name].append(time.perf_counter() - start)
    alone = rows.summary(times["alone"])
    ratios = [alone["median"] / seconds for seconds in times["workers"]]
    return {"bench": BENCH, "case": "cbox, local processes", "method": f"{seeds} seeds, {spp} spp", "seeds": RUNS,
            "settings": {**defaults, "spp": spp, "seeds": seeds}, "efficiency": {str(workers): rows.summary(ratios)},
            "seconds": {name: rows.summary(taken) for name, taken in times.items()}}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default=str(rows.RESULTS / f"{BENCH}.jsonl"), help="file to append to, - to print")
    parser.add_argument("--workers", type=int, nargs="+", default=list(WORKERS), metavar="N")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of a unit (default: %(default)g)")
    parser.add_argument("--res", type=int, default=RES, help="pixels across an image (default: %(default)s)")
    parser.add_argument("--local", type=int, metavar="N", help="measure N processes of this machine instead")
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    where = rows.circumstances()
    found = local_row(args.local) if args.local else row(args.workers, args.views, args.seconds, args.res)
    found |= where
    if args.out == "-":
        print(json.dumps(found, default=float))
    else:
        rows.append(Path(args.out), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
