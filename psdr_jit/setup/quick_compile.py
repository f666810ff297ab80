"""Kernels that compile in half the time and run a little slower: `PSDR_QUICK_COMPILE=1`.

Dr.Jit lets LLVM optimise every kernel (`default<O2>`, instruction selection and scheduling at their highest level).
Its kernels are straight code of vectors that it has simplified itself, so there is little left to win, while those
passes are more than half of the compilation. LLVM's option `opt-bisect-limit` leaves all of them out. That pays where
kernels run a few times only: tests, first looks at a scene, checks of many scenes.

The option is one of the process, for Mitsuba's own integrators as well, so nobody gets it without asking; and kernels
made in this way have a cache of their own, as Dr.Jit knows them by their source alone.
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

from psdr_jit.setup import llvm

VARIABLE = "PSDR_QUICK_COMPILE"
CACHE_VARIABLE = "DRJIT_CACHE_DIR"  # Dr.Jit's own; read when drjit is imported
CACHE_FOLDER = ".drjit-quick"  # in the user's home, beside Dr.Jit's .drjit
LLVM_OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0")
OLDEST_MAJOR = 16  # LLVM before that does not know the second one, and ends the process over an unknown option


def is_asked(environment: Mapping[str, str]) -> bool:
    """Whether `environment` asks for quick compilation."""
    return environment.get(VARIABLE, "") not in ("", "0")


def of_child(environment: Mapping[str, str]) -> dict[str, str]:
    """`environment` for a child process that compiles quickly, unless it says otherwise itself."""
    child = {VARIABLE: "1", **environment}
    if is_asked(child):
        child.setdefault(CACHE_VARIABLE, own_cache())
    return child


def own_cache() -> str:
    """The folder for kernels made in this way."""
    return str(Path.home() / CACHE_FOLDER)


def apply_if_asked() -> None:
    """Set LLVM's options if the environment asks for them; warn if that cannot be done.

    Called at `import psdr_jit`, when the library is chosen.
    """
    if not is_asked(os.environ):
        return
    problem = mixed_kernels() or set_options(os.environ.get(llvm.VARIABLE))
    if problem is not None:
        warnings.warn(f"{VARIABLE} has no effect: {problem}", stacklevel=3)
    elif not os.environ.get(CACHE_VARIABLE):
        os.environ[CACHE_VARIABLE] = own_cache()


def mixed_kernels() -> str | None:
    """Why this process cannot have a kernel cache of its own, or None."""
    if os.environ.get(CACHE_VARIABLE) or "drjit" not in sys.modules:
        return None
    return f"drjit was imported before psdr_jit; import psdr_jit first, or set {CACHE_VARIABLE} as well"


def set_options(library: str | None) -> str | None:
    """Hand the options to `library`, the file that Dr.Jit loads; returns why that is not possible, or None."""
    if not library:
        return "no LLVM was chosen; run: psdr doctor"
    try:
        loaded = ctypes.CDLL(library)
        loaded.LLVMGetVersion  # noqa: B018  came with LLVM 16
    except (OSError, AttributeError) as error:
        return f"{library} is no LLVM of version {OLDEST_MAJOR} or newer ({error})"
    words = [word.encode() for word in ("psdr", *LLVM_OPTIONS)]
    loaded.LLVMParseCommandLineOptions(len(words), (ctypes.c_char_p * len(words))(*words), None)
    return None
