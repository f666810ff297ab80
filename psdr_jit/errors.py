"""The typed errors of psdr_jit. Every message names the cause and the way out.

User mistakes derive from `ValueError`, missing features from `NotImplementedError`, so that code which
only knows Python's own hierarchy still catches what it expects.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PsdrError(Exception):
    """Root of all errors raised on purpose by psdr_jit."""


class ParameterError(PsdrError, ValueError):
    """A scene parameter is unknown, has the wrong type, or cannot be differentiated."""


class OptionError(PsdrError, ValueError):
    """An integrator or command-line option is out of its range."""


class SceneError(PsdrError, ValueError):
    """The scene itself is malformed: unreadable file, empty mesh, NaN vertices."""


class UnsupportedError(PsdrError, NotImplementedError):
    """The scene is valid, but asks for a term or feature that psdr_jit does not model."""


class SetupError(PsdrError, RuntimeError):
    """The machine lacks something psdr_jit needs, such as a working LLVM."""


class SetupWarning(UserWarning):
    """The machine lacks something that is needed sooner or later; the message says how to get it."""


class ZeroDerivativeWarning(UserWarning):
    """The derivative is 0 everywhere; the message says why."""


class UnsupportedWarning(UserWarning):
    """A part of the derivative is not modelled; the message names it."""


class StorageError(PsdrError, OSError):
    """The disk did not take a file: it is full, over quota, or broken."""


class CheckpointError(PsdrError, RuntimeError):
    """The state of an optimisation cannot be written or read."""


class LockedError(PsdrError, RuntimeError):
    """Another run is at work in the folder."""


class StalledWarning(UserWarning):
    """A variable has had no gradient for several iterations; the message says why."""


class ClusterError(PsdrError, RuntimeError):
    """Other processes or machines cannot do their part: they are gone, full, or have other packages."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`"; did you mean 'near'?"` with the name in `known` that is nearest to `name`, or nothing if none is near."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
