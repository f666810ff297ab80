"""Files that are whole or not there: written beside their destination, flushed to the disk, then renamed."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from psdr_jit.errors import OptionError, PsdrError, StorageError

#: What a disk says that is full, over quota, over a limit of the process, or broken: another name would not help.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def replace(path: str | os.PathLike, write: Callable[[str], None]) -> Path:
    """Let `write` fill a temporary file in the same folder, flush it, then rename it; nothing is left on failure.

    Raises `StorageError` if the disk does not take it; a file that was there before is then intact.
    """
    path, temporary = Path(path), ""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".psdr-", suffix=path.suffix)
        os.close(handle)
        write(temporary)
        _flush(temporary)
        # mkstemp files are private; give this one the mode any new file would have
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        raise StorageError(_said(path, error.strerror or str(error))) from error
    except RuntimeError as error:  # OpenEXR and Mitsuba say this where Python says OSError
        causes = [os.strerror(number) for number in NO_ROOM if os.strerror(number) in str(error)]
        if not causes:
            raise
        raise StorageError(_said(path, causes[0])) from error
    finally:
        if os.path.exists(temporary):
            os.unlink(temporary)
    return path


def write_bytes(path: str | os.PathLike, content: bytes) -> Path:
    """`replace` by `content`."""

    def write(temporary: str) -> None:
        with open(temporary, "wb") as file:
            file.write(content)

    return replace(path, write)


def refusal(path: str | os.PathLike, error: OSError) -> PsdrError:
    """The typed form of an error while a folder is being made: the disk's fault, or that of the name."""
    if error.errno in NO_ROOM:
        return StorageError(_said(path, error.strerror))
    return OptionError(f"cannot write '{path}': {error.strerror or error}; choose another folder")


def _flush(path: str) -> None:
    """Whether all of it has arrived, some file systems know only now."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _said(path: str | os.PathLike, cause: str) -> str:
    return f"'{path}' could not be written: {cause}; make room, or choose another folder"
