"""Fetch a libLLVM and the libraries it needs from the system's apt archives, without root.

The files go to `llvm/<package>/` in the environment, symbolic links and all, nothing else of the packages.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from psdr_jit.errors import SetupError
from psdr_jit.setup import private_apt, system_advice

Found = TypeVar("Found")

OWN_MARK = "psdr-made"  # the launcher leaves this file in an environment that it made
PACKAGES = "^libllvm[0-9]+(t64)?$"
OLDEST_MAJOR = 15  # Dr.Jit needs opaque pointers


def state_folder() -> Path:
    """Where our files live: the environment if it is one, else the user's cache (never /usr)."""
    is_environment = sys.prefix != sys.base_prefix or os.path.isdir(os.path.join(sys.prefix, "conda-meta"))
    if is_environment:
        return Path(sys.prefix)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "psdr_jit"


def library_folder() -> Path:
    """Parent of the fetched libraries' folders."""
    return state_folder() / "llvm"


def is_own_environment() -> bool:
    """Whether this Python runs in an environment that the launcher made."""
    return os.path.isfile(os.path.join(sys.prefix, OWN_MARK))


def say(text: str) -> None:
    """One line of progress."""
    print(f"psdr: {text}", file=sys.stderr, flush=True)


def fetch(accept: Callable[[str], Found | None]) -> Found | None:
    """Fetch libLLVM packages, newest first, until `accept` takes the library; return what it returned.

    Returns None where there is no apt or none passed; raises `SetupError` if the archives are out of reach.
    """
    if not private_apt.is_available():
        return None
    library_folder().mkdir(parents=True, exist_ok=True)
    # Inside the environment, so that the finished folder can be renamed into place.
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=library_folder()) as scratch:
        work = Path(scratch)
        try:
            say("no LLVM of this system works; reading the package lists (apt, without root) ...")
            config = private_apt.update(work)
            for package in newest_first(private_apt.package_names(config, PACKAGES)):
                found = fetch_one(config, package, work / package, accept)
                if found is not None:
                    return found
        except private_apt.AptError as error:
            raise SetupError("\n".join([f"LLVM could not be fetched: {error}", *advice()])) from error
    return None


def newest_first(packages: list[str]) -> list[str]:
    """Package names by falling LLVM version, without those known to be too old."""
    versions = {name: int(re.sub(r"^libllvm|t64$", "", name)) for name in packages}
    return sorted((n for n in versions if versions[n] >= OLDEST_MAJOR), key=lambda n: -versions[n])


def fetch_one(config: Path, package: str, work: Path, accept: Callable[[str], Found | None]) -> Found | None:
    """Fetch `package` into its folder and keep it there if `accept` takes it."""
    names = private_apt.with_dependencies(config, package)
    say(f"fetching {package} and {len(names) - 1} libraries it needs ...")
    private_apt.unpack(config, names, work)
    folder = library_folder() / package
    shutil.rmtree(folder, ignore_errors=True)
    collected = private_apt.collect_libraries(work, work / "collected")
    os.replace(collected, folder)
    shutil.rmtree(work)
    for library in sorted(folder.glob("libLLVM*.so*")):
        found = None if library.is_symlink() else accept(str(library))
        if found is not None:
            return found
    shutil.rmtree(folder)
    return None


def newest_known_package() -> str:
    """Newest libLLVM package in the system's own lists; a common name where they are empty or not apt's."""
    try:
        known = private_apt.package_names(None, PACKAGES) if private_apt.is_available() else []
    except private_apt.AptError:
        known = []
    return (newest_first(known) or ["libllvm19"])[0]


def advice() -> list[str]:
    """Lines that say how to get an LLVM by hand."""
    lines = [f"install one:  {system_advice.install_command('llvm', newest_known_package())}"]
    if private_apt.is_available():
        lines.append("or, without root and with a network:  psdr doctor --fix")
    return [*lines, "or name one:  export DRJIT_LIBLLVM_PATH=/full/path/to/libLLVM.so"]
