"""One run at a time in a folder. The kernel drops the lock when its holder dies, so there is none to clean up."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from psdr_jit.core import files
from psdr_jit.errors import LockedError

NAME = "running"  # in the folder of a run, as long as it runs: who it is

READ = 1000  # bytes of it that are shown at most


def require_free(folder: Path) -> None:
    """Raise `LockedError` if a run is at work in the folder."""
    path = folder / NAME
    if path.is_file() and os.access(path, os.R_OK | os.W_OK):
        with open(path, "rb+", buffering=0) as file:
            _lock(file, folder)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """The folder, made if need be, is this run's own. Raises `LockedError` if it is another's."""
    path = folder / NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _acquired(path, folder)
    except LockedError:
        raise
    except OSError as error:
        raise files.refusal(folder, error) from error
    try:
        _sign(file, path)
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def _acquired(path: Path, folder: Path) -> Any:
    """The open and locked file. The one before may be removed by its holder while this waits to lock it."""
    while True:
        file = open(path, "ab+", buffering=0)
        try:
            _lock(file, folder)
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                return file
        except BaseException:
            file.close()
            raise
        file.close()


def _lock(file: Any, folder: Path) -> None:
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.seek(0)
        who = " ".join(file.read(READ).decode(errors="replace").split()) or "another process"
        raise LockedError(
            f"a run is at work in '{folder}': {who}; wait for its end, or choose another folder (--out)"
        ) from error
    except OSError:
        pass  # a file system without locks


def _sign(file: Any, path: Path) -> None:
    """Say who runs here. What an earlier run that was killed has left is replaced."""
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}, since {since}\n".encode())
    except OSError as error:
        raise files.refusal(path, error) from error
