"""Libraries that Dr.Jit's own binaries need and a bare system lacks (libatomic.so.1 on a minimal Debian).

Dr.Jit's wheel looks for them beside its own files ($ORIGIN), so a copy put there serves every process of the
environment, also one that imports mitsuba before psdr_jit.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from psdr_jit.errors import SetupError
from psdr_jit.setup import llvm_fetch, private_apt, system_advice

IMPORT_SECONDS = 180.0
NO_PLUGINS = "PSDR_NO_PLUGINS"  # environment variable, set by the launcher for commands that do not render
DEBIAN_PACKAGES = {"libatomic.so.1": "libatomic1"}
MISSING = re.compile(r"(\S+\.so[.\d]*): cannot open shared object file")


def mitsuba_can_load() -> bool:
    """Whether `import mitsuba` has a chance: both packages are there and Dr.Jit's core library loads.

    Cheap and without importing either. `import psdr_jit` asks this first, because the doctor and the set-up
    live in psdr_jit and have to run where Mitsuba does not. They also ask for it to be left alone
    (`NO_PLUGINS`): `import mitsuba` loads an LLVM at once, before they could choose one.
    """
    if os.environ.get(NO_PLUGINS):
        return False
    spec = importlib.util.find_spec("drjit")
    if spec is None or not spec.submodule_search_locations or importlib.util.find_spec("mitsuba") is None:
        return False
    core = Path(spec.submodule_search_locations[0]) / "libnanothread.so"  # the one that needs libatomic
    try:
        return not core.exists() or ctypes.CDLL(str(core)) is not None
    except OSError:
        return False


def missing_library() -> str | None:
    """The first library that `import drjit` lacks; None if it has all. Other failures are not ours to see."""
    command = [sys.executable, "-c", "import drjit"]
    child = subprocess.run(command, capture_output=True, text=True, timeout=IMPORT_SECONDS, cwd=os.sep)
    found = MISSING.search(child.stderr)
    return found.group(1) if child.returncode != 0 and found else None


def advice(library: str) -> str:
    """How to get `library` by hand."""
    if library in DEBIAN_PACKAGES:
        return f"install it:  {system_advice.install_command('libatomic')}"
    return f"install the package of your system that contains {library}"


def provide_missing() -> None:
    """Put the libraries that `import drjit` lacks beside it; raise `SetupError` where that cannot be done."""
    for _ in range(len(DEBIAN_PACKAGES) + 1):
        library = missing_library()
        if library is None:
            return
        package = DEBIAN_PACKAGES.get(library)
        if package is None or not private_apt.is_available():
            break
        llvm_fetch.say(f"fetching {library}, which Dr.Jit needs (apt, without root) ...")
        try:
            copy_beside_drjit(library, package)
        except private_apt.AptError as error:
            raise SetupError(f"{library} could not be fetched: {error}\n{advice(library)}") from error
    raise SetupError(f"Dr.Jit needs {library}, which this system lacks\n{advice(library)}")


def copy_beside_drjit(library: str, package: str) -> None:
    """Fetch `package` and copy its `library` into the folder of the drjit package."""
    spec = importlib.util.find_spec("drjit")
    if spec is None or not spec.submodule_search_locations:
        raise SetupError("drjit is not installed; install it with: pip install mitsuba")
    folder = Path(spec.submodule_search_locations[0])
    with tempfile.TemporaryDirectory(prefix="psdr-fetch-") as scratch:
        work = Path(scratch)
        private_apt.unpack(private_apt.update(work), [package], work / "tree")
        collected = private_apt.collect_libraries(work / "tree", work / "collected")
        if not (collected / library).exists():
            raise SetupError(f"the package {package} does not contain {library}\n{advice(library)}")
        shutil.copy(collected / library, folder / f"{library}.new")
    os.replace(folder / f"{library}.new", folder / library)
