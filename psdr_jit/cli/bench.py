"""Measure accuracy against speed, stability and cost with the benchmarks of this checkout; see psdr bench --help."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

from psdr_jit.cli.test import checkout, environment
from psdr_jit.setup import llvm

NAME = "bench"
HELP = "measure accuracy, speed and stability (needs a clone)"

INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`main` hands over everything that follows `bench` unparsed."""
    parser.add_argument("rest", nargs="*", metavar="ARG", help="passed on to the benchmarks")


def run(args: argparse.Namespace) -> int:
    """Exit status of `python -m benchmarks.run`, which runs where the user stands."""
    root = checkout("benchmarks", NAME)
    llvm.ensure_llvm()
    paths = [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
    child = {**environment(), "PYTHONPATH": os.pathsep.join(paths)}
    try:
        command = [sys.executable, "-m", "benchmarks.run", *args.rest]
        return subprocess.run(command, env=child, check=False).returncode
    except KeyboardInterrupt:
        return INTERRUPTED
