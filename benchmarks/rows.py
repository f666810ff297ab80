"""Benchmark rows: one JSON object per line, with everything needed to judge the number later.

A row has `bench`, `case`, `method`, `settings`, `seeds`, the measurements as `summary` makes them, and the
circumstances from `circumstances`. Rows are appended, never edited: a new run of the same case replaces the old
one in reports, not in the file.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def summary(values: Sequence[float]) -> dict[str, float]:
    """Median and spread of repeated measurements."""
    low, q1, median, q3, high = np.percentile(values, (0, 25, 50, 75, 100))
    return {"median": median, "q1": q1, "q3": q3, "min": low, "max": high, "n": len(values)}


def circumstances() -> dict[str, Any]:
    """Machine, load, versions and commit. Reading them needs an active variant."""
    return {
        "machine": machine(),
        "load": os.getloadavg()[0],  # processes that wanted to run in the last minute, this one included
        "versions": versions(),
        "commit": commit(),
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def machine() -> dict[str, Any]:
    """Processor, cores and system; for a CUDA variant the device and its driver as well."""
    import mitsuba as mi

    found = {"cpu": cpu_model(), "cores": len(os.sched_getaffinity(0)), "system": platform.system()}
    return {**found, "gpu": gpu_model()} if mi.variant().startswith("cuda") else found


def gpu_model() -> str:
    """Name and driver of the first device, as NVIDIA's tool gives them."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        return subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines()[0].strip()
    except (OSError, subprocess.CalledProcessError, IndexError):
        return "unknown"


def cpu_model() -> str:
    """As the kernel names it; `platform.processor()` is empty on most Linux systems."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    import drjit as dr
    import mitsuba as mi

    backend = "cuda" if mi.variant().startswith("cuda") else "llvm"
    version = dr.detail.cuda_version() if backend == "cuda" else dr.detail.llvm_version()
    return {"python": platform.python_version(), "mitsuba": mi.__version__, "drjit": dr.__version__,
            backend: ".".join(str(part) for part in version), "variant": mi.variant()}  # fmt: skip


def commit() -> str:
    """The commit of this checkout, with `+` if files other than results differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ".", f":!{RESULTS.relative_to(ROOT)}")
        return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def append(path: Path, row: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, default=float) + "\n")


def read(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """All rows of several files, in order."""
    return [json.loads(line) for path in paths for line in path.read_text(encoding="utf-8").splitlines() if line]


def latest(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """The newest row of each (bench, case, method), in order of first appearance."""
    newest: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in rows:
        key = (row["bench"], row["case"], row["method"])
        if key not in newest or row["date"] >= newest[key]["date"]:
            newest[key] = row
    return list(newest.values())
