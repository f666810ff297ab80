"""Stops before a kernel is compiled with an LLVM that fails: such a library does not raise, it ends the process.

`import mitsuba` has Dr.Jit load a library, whoever chose it. Here that very library is asked for, once a process, when
an LLVM variant is first set; a library that has passed before costs one small file.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from functools import cache
from pathlib import Path

from psdr_jit.errors import SetupError, SetupWarning
from psdr_jit.setup import llvm, llvm_fetch

MAPS = Path("/proc/self/maps")
COMMAND = "psdr_jit.cli.main"


def warn_without_backend() -> None:
    """Warn where Dr.Jit found neither a CUDA device nor an LLVM that it can load: no variant will start.

    Not in the `psdr` command, which looks for a library itself.
    """
    import drjit as dr

    if COMMAND in sys.orig_argv or Path(sys.argv[0]).stem == "psdr":
        return
    if not dr.has_backend(dr.JitBackend.LLVM) and not dr.has_backend(dr.JitBackend.CUDA):
        named = llvm.user_path()
        what = f"{llvm.VARIABLE}={named} cannot be loaded" if named else "Dr.Jit found no LLVM that it can load"
        text = "\n".join([f"{what}: no variant with derivatives will start", *llvm_fetch.advice()])
        warnings.warn(text, SetupWarning, stacklevel=2)


def require_working_llvm(variant: str) -> None:
    """Raise `SetupError` with the way out unless the LLVM of this process can compile kernels."""
    if not variant.startswith("llvm"):
        return
    found = trouble()
    if found:
        raise SetupError(found)


@cache
def trouble() -> str:
    """What is wrong with the library that Dr.Jit has loaded; empty if it has passed a probe."""
    named = llvm.user_path()
    if named:
        try:
            llvm.accept_user_path(named)
        except SetupError as error:
            return str(error)
        return ""
    saved, path = llvm.read_choice(), loaded_library()
    if saved is not None and path in (None, os.path.realpath(saved.path)) and llvm.is_fresh(saved):
        return ""
    if path is None:  # a system that does not tell what is loaded
        choice, verdicts = llvm.try_candidates()
        return "" if choice is not None else llvm.no_llvm_message(verdicts)
    verdict = llvm.probe(path)
    if verdict.choice is not None:
        if saved is None or not llvm.is_fresh(saved):
            llvm.save_choice(verdict.choice)
        return ""
    choice, verdicts = llvm.try_candidates()
    if choice is None:
        return llvm.no_llvm_message(verdicts)
    llvm.save_choice(choice)
    return (
        f"Dr.Jit has loaded {path}, which {verdict.reason}\n"
        f"  {choice.path} works and is used from the next start on: run this again, and import psdr_jit before mitsuba"
    )


def loaded_library() -> str | None:
    """The libLLVM that this process has loaded; None where the system does not tell."""
    try:
        found = re.findall(r"\s(/\S*libLLVM[^/\s]*\.so[^/\s]*)$", MAPS.read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        return None
    return os.path.realpath(found[0]) if found else None
