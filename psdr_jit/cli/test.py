"""Run the tests of this clone with pytest, in the environment of this command.

Everything after `test` goes to pytest as it is; without arguments the whole suite runs, but not the tests marked slow
(finite-difference references that take minutes). The tests are in a clone only, and pytest runs in its root, in as many
processes as there are cores (`-n 0`: in one, as with `-s` or `--pdb`). Kernels are compiled quickly, see the README
(PSDR_QUICK_COMPILE=0: as they are for users).

    ./psdr test                             all but the slow ones
    ./psdr test -m slow                     the slow ones
    ./psdr test -k edges -x                 those with "edges" in the name, up to the first failure
    ./psdr test tests/unit/docs             those of one folder or file

Exit status: 0 all passed, 1 a test failed or could not be collected, 2 wrong arguments or no test chosen,
3 no clone, no pytest or no LLVM that works. pytest lists its own options with: python -m pytest --help
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import psdr_jit
from psdr_jit.errors import SetupError
from psdr_jit.setup import drjit_libraries, llvm, quick_compile

NAME = "test"
HELP = "run the test suite (needs a clone)"

NO_BYTECODE, BYTECODE_FOLDER = "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"  # Python's own
EXIT_STATUS = {0: 0, 4: 2, 5: 2}  # pytest: all passed; wrong usage; nothing selected


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """For the help text only: `main` hands over everything that follows `test` unparsed."""
    parser.usage = "psdr test [-h] [ARG ...]"
    parser.add_argument("rest", nargs="*", metavar="ARG", help="option, file or folder for pytest")


def checkout(folder: str, command: str) -> Path:
    """Root of the clone that this package was imported from; `folder` is in clones only, and `command` needs it."""
    root = Path(psdr_jit.__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file() or not (root / folder).is_dir():
        raise SetupError(
            f"the {folder} are not part of the installed package; clone the repository and run:  ./psdr {command}"
        )
    return root


def environment() -> dict[str, str]:
    """Of a child process, which loads the plugins even if this one was told not to."""
    return {key: value for key, value in os.environ.items() if key != drjit_libraries.NO_PLUGINS}


def environment_of_tests() -> dict[str, str]:
    """Kernels of tests run once or twice: to compile them is most of the time that the suite takes.

    Tests start many Python processes. Where Python is told to leave no bytecode beside sources, it goes to a folder of
    its own, or every process would compile all modules.
    """
    child = quick_compile.of_child(environment())
    if child.pop(NO_BYTECODE, ""):
        child.setdefault(BYTECODE_FOLDER, os.path.join(quick_compile.own_cache(), "bytecode"))
    return child


def run(args: argparse.Namespace) -> int:
    """pytest's verdict as one of ours; a crash or an error while collecting is a failed check."""
    root = checkout("tests", NAME)
    if importlib.util.find_spec("pytest") is None:
        raise SetupError(f"pytest is not installed; run:  {sys.executable} -m pip install -e '{root}[test]'")
    llvm.ensure_llvm()
    given = [absolute(word, root) for word in args.rest]
    command = [sys.executable, "-m", "pytest", *processes(given), *given]
    status = subprocess.run(command, cwd=root, env=environment_of_tests(), check=False).returncode
    return EXIT_STATUS.get(status, 1)


def processes(given: list[str]) -> list[str]:
    """Options that let pytest use all cores: most of its time is spent compiling kernels, each on one core.

    Neighbouring tests share kernels, so each process starts with a stretch of them and takes over what is left of the
    other's. Not where pytest is told to do otherwise, or to talk to a terminal.
    """
    alone = ("-n", "--numprocesses", "--dist", "--pdb", "-s", "--capture", "--collect-only", "--co", "-p")
    if any(word.startswith(alone) for word in given) or importlib.util.find_spec("xdist") is None:
        return []
    return ["-n", "auto", "--dist", "worksteal"]


def absolute(word: str, root: Path) -> str:
    """pytest runs in the checkout; a path relative to where the user stands must survive that."""
    path = word.split("::", 1)[0]
    return os.path.abspath(word) if os.path.exists(path) and not (root / path).exists() else word
