"""The `psdr` command: finds the subcommand, makes sure that LLVM works, maps errors to exit statuses.

0 success; 1 a check did not pass, or an optimisation diverged; 2 wrong usage or input; 3 the machine lacks
something, its disk is full, or something failed that nobody foresaw; 130 interrupted. A subcommand is a module with
`NAME`, `HELP`, `add_arguments(parser)` and `run(args) -> int`. It is imported only when it is the one asked for, so
that `psdr --help` needs neither Mitsuba nor time.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psdr_jit
from psdr_jit.errors import ClusterError, PsdrError, SetupError, StorageError

OK, USAGE, SETUP_MISSING, UNFORESEEN, INTERRUPTED = 0, 2, 3, 3, 130
TRACEBACK_VARIABLE = "PSDR_TRACEBACK"


@dataclass(frozen=True)
class Command:
    """One line of the help, and the module behind it."""

    module: str
    help: str
    renders: bool  # needs a working backend before it runs


COMMANDS = {
    "render": Command("psdr_jit.cli.render", "render a scene", renders=True),
    "gradient": Command(
        "psdr_jit.cli.gradient", "differentiate a scene by one of its parameters", renders=True
    ),
    "optimize": Command("psdr_jit.cli.optimize", "recover parameters of a scene from images", renders=True),
    "plan": Command("psdr_jit.cli.plan", "show what differentiating a scene would compute, and why", renders=True),
    "report": Command("psdr_jit.cli.report", "make one HTML page of a derivative or an optimisation", renders=False),
    "params": Command("psdr_jit.cli.params", "list the parameters of a scene", renders=True),
    "demo": Command("psdr_jit.cli.demo", "run the bundled scenes and show their gradients", renders=True),
    "doctor": Command("psdr_jit.cli.doctor", "check Python, Mitsuba, Dr.Jit and LLVM", renders=False),
    "bench": Command("psdr_jit.cli.bench", "measure accuracy, speed and stability (needs a clone)", renders=False),
    "test": Command("psdr_jit.cli.test", "run the test suite (needs a clone)", renders=False),
}
PASSED_ON = ("bench", "test")  # commands whose options are not ours to know
OWN_HELP = ("test",)  # of those: the help is ours, the program behind it would print its own
HELP_FLAGS = {"-h", "--help"}


def build_parser(wanted: str | None) -> argparse.ArgumentParser:
    """The parser; only the subcommand `wanted` gets its arguments."""
    parser = argparse.ArgumentParser(prog="psdr", description=psdr_jit.__doc__.splitlines()[0])
    parser.add_argument("--version", action="version", version=f"psdr_jit {psdr_jit.__version__}")
    parser.epilog = f"{TRACEBACK_VARIABLE}=1 shows the Python traceback of an error."
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        if name == wanted:
            module = importlib.import_module(command.module)
            subparser = subparsers.add_parser(name, help=command.help, description=module.__doc__)
            subparser.formatter_class = argparse.RawDescriptionHelpFormatter
            module.add_arguments(subparser)
            subparser.set_defaults(run=module.run)
        else:
            subparsers.add_parser(name, help=command.help)
    return parser


def prepare_backend(args: argparse.Namespace, restart: bool) -> None:
    """Make sure that a kernel can be compiled. A variant that was asked for by name may not need LLVM.

    `import mitsuba` has loaded an LLVM already. If the choice turns out to be another (first use after a
    plain `pip install`, or a library was removed), only a new process can load that one: `restart`.
    """
    variant = getattr(args, "variant", None) or ""
    if variant.startswith(("cuda", "scalar")):
        return
    from psdr_jit.setup import llvm

    before = os.environ.get(llvm.VARIABLE)
    choice = llvm.ensure_llvm()
    if restart and choice.path != before and "drjit" in sys.modules:
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def dispatch(argv: list[str], restart: bool) -> int:
    """Parse and run."""
    wanted = next((word for word in argv if not word.startswith("-")), None)
    parser = build_parser(wanted)
    if wanted in PASSED_ON:
        rest = argv[argv.index(wanted) + 1 :]
        asked = ["--help"] if wanted in OWN_HELP and HELP_FLAGS & set(rest) else []
        args, args.rest = parser.parse_args([wanted, *asked]), rest
    else:
        args = parser.parse_args(argv)
    if COMMANDS[args.command].renders:
        prepare_backend(args, restart)
    return args.run(args)


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Show every warning once, as one line of ours instead of a line of source code."""
    said = set()

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        if str(message) not in said:
            said.add(str(message))
            print(f"psdr: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def chain(error: BaseException) -> Iterator[BaseException]:
    """An error and what is behind it: Dr.Jit and Mitsuba wrap what is raised while they trace."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = found.__cause__ or found.__context__


def explained(error: BaseException) -> tuple[int, str]:
    """Exit status and message of an error."""
    behind = list(chain(error))
    for found in behind if isinstance(error, RuntimeError) else [error]:
        if isinstance(found, KeyboardInterrupt):
            return INTERRUPTED, "interrupted"
        if isinstance(found, PsdrError):
            lacking = isinstance(found, (ClusterError, SetupError, StorageError))
            return SETUP_MISSING if lacking else USAGE, f"error: {found}"
        if isinstance(found, MemoryError) or "out of memory" in str(found):
            return SETUP_MISSING, "error: out of memory: use fewer samples per pixel, or a smaller image"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return SETUP_MISSING, f"error: {error.strerror.lower()}: make room where the output goes"
    if isinstance(error, ModuleNotFoundError) and (error.name or "psdr_jit").split(".")[0] != "psdr_jit":
        return SETUP_MISSING, f"error: the package '{error.name}' is not installed; see: psdr doctor"
    shown = behind[-1] if "see above" in str(error) else error  # so says Dr.Jit, and its user sees nothing above
    text = " ".join(str(shown).split()) or "no more is known"
    where = f"(not foreseen; {TRACEBACK_VARIABLE}=1 shows where)"
    return UNFORESEEN, f"error: {type(shown).__name__}: {text} {where}"


def main(argv: list[str] | None = None) -> int:
    """Entry point of the console script."""
    try:
        with plain_warnings():
            status = dispatch(sys.argv[1:] if argv is None else argv, restart=argv is None)
            sys.stdout.flush()
            return status
    except BrokenPipeError:  # the reader (`| head`) has left
        settle_output()
        return OK
    except KeyboardInterrupt:
        print("psdr: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:  # noqa: BLE001  the last resort: whatever it is, it becomes one line
        settle_output()
        if os.environ.get(TRACEBACK_VARIABLE) == "1":
            traceback.print_exc()
        status, message = explained(error)
        print(f"psdr: {message}", file=sys.stderr)
        return status


def settle_output() -> None:
    """Drop what cannot be printed: Python would fail once more when it flushes at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
