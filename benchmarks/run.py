"""Measure, chart and tabulate: accuracy against speed, stability where methods fail, cost curves.

A row that exists is not measured again, so that an interrupted run continues where it stopped. Rows are JSON lines in
the folder --out; --report makes charts and tables from them and computes nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks import rows
from benchmarks.suites import ON_REQUEST, REFERENCE, SUITES, suite
from benchmarks.worker import DONE, START
from psdr_jit.cli import common
from psdr_jit.core import progress
from psdr_jit.errors import PsdrError
from psdr_jit.scene import io as scene_io

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
QUICK_BUDGET = 2.0  # [s] at most
QUICK_FOLDER = Path("out") / "bench-quick"
PATIENCE = 240.0  # [s] without a word from a worker, beside what the budget explains
BUDGETS_OF_PATIENCE = 8.0


@dataclass(frozen=True)
class Task:
    suite: str
    case: str
    method: str


def parser() -> argparse.ArgumentParser:
    budgets = ", ".join(f"{name} {suite(name).BUDGET:g}" for name in SUITES + ON_REQUEST)
    p = argparse.ArgumentParser(prog="psdr bench", description=__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--suite", action="append", choices=SUITES + ON_REQUEST,
                   help=f"default: all but {', '.join(ON_REQUEST)}; may be repeated")
    p.add_argument("--cases", metavar="A,B", help="only cases whose name contains one of these words")
    p.add_argument("--methods", metavar="A,B", help="only methods whose name contains one of these words")
    p.add_argument("--budget", type=float, metavar="S",
                   help=f"seconds of rendering per case and method (default: {budgets}; "
                        f"--quick: {QUICK_BUDGET:g} at most)")
    p.add_argument("--quick", action="store_true",
                   help=f"a few cases, short: ten minutes on two cores; rows go to {QUICK_FOLDER}")
    p.add_argument("--out", type=Path, metavar="DIR",
                   help=f"folder of rows, references and charts (default: {rows.RESULTS.relative_to(rows.ROOT)})")
    p.add_argument("--redo", action="store_true", help="measure anew what has a row already")
    p.add_argument("--list", action="store_true", help="list cases and methods, measure nothing")
    p.add_argument("--report", action="store_true", help="make charts and tables from stored rows, measure nothing")
    p.add_argument("--variant", default=scene_io.DEFAULT_VARIANT, help="Mitsuba variant (default: %(default)s)")
    return p


def tasks(args: argparse.Namespace) -> list[Task]:
    """Everything that was asked for, in the order of the suites."""
    found = []
    for name in args.suite or SUITES:
        module = suite(name)
        for case in module.quick_case_names() if args.quick else module.case_names():
            if chosen(case, args.cases):
                names = module.method_names(case)
                found += [Task(name, case, m) for m in names if m == REFERENCE or chosen(m, args.methods)]
    return found


def chosen(name: str, words: str | None) -> bool:
    return words is None or any(word.strip().lower() in name.lower() for word in words.split(",") if word.strip())


def budget_of(name: str, args: argparse.Namespace) -> float:
    """Seconds of rendering that a method gets per case of a suite."""
    if args.budget is not None:
        return args.budget
    return min(QUICK_BUDGET, suite(name).BUDGET) if args.quick else suite(name).BUDGET


def done(folder: Path, names: tuple[str, ...]) -> set[Task]:
    """Tasks that have a row."""
    paths = [path for name in names if (path := folder / f"{name}.jsonl").is_file()]
    return {Task(path.stem, row["case"], row["method"]) for path in paths for row in rows.read([path])}


def measure(pending: list[Task], args: argparse.Namespace) -> int:
    """One worker per case; the number of tasks that a worker did not survive."""
    lost, finished = 0, 0
    with progress.bar("bench") as report:
        for name, case in dict.fromkeys((task.suite, task.case) for task in pending):
            left = [task.method for task in pending if (task.suite, task.case) == (name, case)]
            while left:
                reached = len(left)
                left, failure = run_worker(name, case, left, args)
                finished += reached - len(left)
                lost += failure is not None
                report(finished, len(pending), f"{name}: {case}")
    return lost


def run_worker(name: str, case: str, methods: list[str], args: argparse.Namespace) -> tuple[list[str], str | None]:
    """Methods that are left, and what ended the worker if it did not end by itself. That method gets a row as well."""
    budget = budget_of(name, args)
    request = {"suite": name, "case": case, "methods": methods, "folder": str(args.out), "budget": budget,
               "variant": args.variant}  # fmt: skip
    worker = subprocess.Popen([sys.executable, "-m", "benchmarks.worker"], cwd=rows.ROOT, stdin=subprocess.PIPE,
                              stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
    errors: list[str] = []
    reader = threading.Thread(target=lambda: errors.extend(worker.stderr), daemon=True)
    reader.start()
    watchdog = Watchdog(worker, PATIENCE + BUDGETS_OF_PATIENCE * budget)
    current, left = methods[0], list(methods)
    try:
        worker.stdin.write(json.dumps(request))
        worker.stdin.close()
        for line in worker.stdout:
            watchdog.reset()
            word, _, text = line.strip().partition(" ")
            if word == START:
                current = text
            elif word == DONE:
                left.remove(current)
                print(f"{name}: {case}: {text}", flush=True)
        status = worker.wait()
    finally:
        watchdog.stop()
        worker.kill()
    if not left:
        return [], None
    reader.join(timeout=1)
    failure = "no answer within the time limit" if watchdog.bitten else why(status, errors)
    print(f"{name}: {case}: {current}: {failure}", flush=True)
    scene_io.use_variant(args.variant)
    row = {"bench": name, "case": case, "method": current, "settings": {"budget": budget}, "status": "cannot",
           "error": failure}  # fmt: skip
    rows.append(args.out / f"{name}.jsonl", {**row, **rows.circumstances()})
    left.remove(current)
    return left, failure


def why(status: int, errors: list[str]) -> str:
    said = [line.strip() for line in errors if line.strip()]
    ended = f"its process was ended by signal {-status}" if status < 0 else f"its process ended with status {status}"
    return f"{ended}: {said[-1]}" if said else ended


class Watchdog:
    """Kills a worker that says nothing for too long."""

    def __init__(self, worker: subprocess.Popen, patience: float) -> None:
        self.worker, self.patience, self.bitten = worker, patience, False
        self.last = time.monotonic()
        self.over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def reset(self) -> None:
        self.last = time.monotonic()

    def stop(self) -> None:
        self.over.set()

    def _watch(self) -> None:
        while not self.over.wait(1.0):
            if time.monotonic() - self.last > self.patience:
                self.bitten = True
                self.worker.kill()
                return


def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    args.out = (args.out or (QUICK_FOLDER if args.quick else rows.RESULTS)).resolve()
    try:
        if args.budget is not None:
            common.require_positive(budget=args.budget)
        args.out.mkdir(parents=True, exist_ok=True)
    except (PsdrError, OSError) as error:
        print(f"psdr bench: error: {error}", file=sys.stderr)
        return USAGE
    if args.report:
        from benchmarks import report

        return report.write(args.out)
    wanted = tasks(args)
    if not wanted:
        quick = " --quick" if args.quick else ""
        print(f"psdr bench: error: no case and method has such a name; see: psdr bench{quick} --list", file=sys.stderr)
        return USAGE
    if args.list:
        print("\n".join(f"{task.suite}: {task.case}: {task.method}" for task in wanted))
        return OK
    stored = done(args.out, tuple(args.suite or SUITES))
    if args.redo:
        stored = {task for task in stored if not chosen(task.method, args.methods)}
    pending = [task for task in wanted if task not in stored]
    if len(pending) < len(wanted):
        kept = len(wanted) - len(pending)
        print(f"{kept} of {len(wanted)} rows exist in {args.out} and are kept (--redo: measure anew)")
    try:
        lost = measure(pending, args)
    except KeyboardInterrupt:
        print("psdr bench: interrupted; the same command continues with what is left", file=sys.stderr)
        return INTERRUPTED
    elsewhere = "" if args.out == rows.RESULTS else f" --out {args.out}"
    print(f"rows are in {args.out}; charts and tables:  psdr bench --report{elsewhere}")
    return FAILED if lost else OK


if __name__ == "__main__":
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader (`| head`) has left; Python would complain once more when it flushes at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = OK
    sys.exit(status)
