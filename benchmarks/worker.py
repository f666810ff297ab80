"""Measures methods on one case, in a process of its own: a crash or a hang costs one row. Started by `run.py`.

Reads a JSON request from standard input; prints `start METHOD` before and `done METHOD: figures` after each method,
and appends the row to `<folder>/<suite>.jsonl`.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

from benchmarks import rows
from benchmarks.suites import Settings, suite

START, DONE = "start", "done"


def main() -> int:
    request = json.load(sys.stdin)
    settings = Settings(Path(request["folder"]), request["budget"], request["variant"])
    import mitsuba as mi

    from psdr_jit.scene import io as scene_io

    scene_io.use_variant(settings.variant)
    mi.set_log_level(mi.LogLevel.Error)
    warnings.simplefilter("ignore")  # they are about the scene, and the row says what a method cannot do
    module = suite(request["suite"])
    opened = module.open_case(request["case"], settings)
    for method in request["methods"]:
        print(START, method, flush=True)
        row = module.measure(opened, method)
        rows.append(settings.folder / f"{request['suite']}.jsonl", {**row, **rows.circumstances()})
        print(DONE, f"{method}: {summary(row)}", flush=True)
    return 0


def summary(row: dict) -> str:
    """One line about a row for the terminal."""
    if row.get("status") == "cannot":
        return f"cannot ({row['error']})"
    shown = {"gain": ".3f", "error_10s": ".2e", "cost": ".2e", "rms_stderr": ".1e", "relative_rmse": ".3f"}
    if "solved" in row:
        figures = "  ".join(f"{name} {row['before'][name]:.3g} -> {value:.3g}" for name, value in row["after"].items())
        return f"{'solved' if row['solved'] else 'not solved'} in {row['seconds']:.0f} s  {figures}"
    figures = [f"{name} {row[name]:{form}}" for name, form in shown.items() if name in row]
    return "  ".join(figures) or "measured"


if __name__ == "__main__":
    sys.exit(main())
