"""The state of a run in one file, replaced as a whole: whoever stops the process finds the last one complete.

Sampling needs no state: seeds follow from the run's seed and the iteration's number.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from psdr_jit.core import files
from psdr_jit.errors import CheckpointError, StorageError
from psdr_jit.inverse.variables import like, numbers

FORMAT = 1
NAME = "checkpoint.npz"  # in the folder of a run


@dataclass(frozen=True)
class Checkpoint:
    """`iteration` is the next one to run. `arrays`: everything an optimiser holds, by name, flat float64."""

    iteration: int
    fingerprint: str  # of the problem; a run continues only the same one
    arrays: Mapping[str, np.ndarray]
    best: Mapping[str, np.ndarray]  # latents of the best state
    history: Mapping[str, np.ndarray]  # losses, see `History.arrays`, and means of the targets
    seconds: float
    images: Mapping[str, np.ndarray] = field(default_factory=dict)  # carried along, see `control_variate`


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write beside `path`, flush to the disk, then replace. Raises `CheckpointError`; the old file is then intact."""
    header = {"format": FORMAT, "iteration": checkpoint.iteration, "fingerprint": checkpoint.fingerprint,
              "seconds": checkpoint.seconds}  # fmt: skip
    parts = {"now": checkpoint.arrays, "best": checkpoint.best, "history": checkpoint.history,
             "images": checkpoint.images}  # fmt: skip
    named = {f"{part}/{key}": value for part, found in parts.items() for key, value in found.items()}
    content = io.BytesIO()
    np.savez(content, header=json.dumps(header), **named)
    try:
        files.write_bytes(path, content.getvalue())
    except StorageError as error:
        raise CheckpointError(f"{error}; the checkpoint before it is intact") from error


def require(path: Path) -> None:
    """Raise `CheckpointError` unless there is one."""
    if not path.is_file():
        raise CheckpointError(f"there is no checkpoint '{path}' to resume from; start without resuming")


def load(path: Path, fingerprint: str) -> Checkpoint:
    """Raises `CheckpointError` unless there is a complete one of the same problem."""
    require(path)
    try:
        with np.load(path) as file:
            header = json.loads(str(file["header"]))
            arrays = {key: file[key] for key in file.files if key != "header"}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"'{path}' is no checkpoint ({error}); remove it and start anew") from error
    if header.get("format") != FORMAT:
        raise CheckpointError(f"'{path}' was written by another version; remove it and start anew")
    if header["fingerprint"] != fingerprint:
        raise CheckpointError(
            f"'{path}' belongs to another problem: scene, variables, loss, integrator or settings differ from those it "
            "was started with; use another output folder, or remove it"
        )
    return Checkpoint(
        header["iteration"],
        fingerprint,
        _below("now/", arrays),
        _below("best/", arrays),
        _below("history/", arrays),
        header["seconds"],
        _below("images/", arrays),
    )


def _below(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}


def optimiser_arrays(optimisers: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Values and moments of Dr.Jit optimisers by name."""
    return {f"{owner}/{key}": numbers(leaf) for owner, opt in optimisers.items() for key, leaf in _leaves(opt.state)}


def make_opaque(optimiser: Any) -> None:
    """Evaluate everything that an optimiser holds."""
    for _, leaf in _leaves(optimiser.state):
        dr.make_opaque(leaf)


def restore_optimisers(optimisers: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Put back what `optimiser_arrays` returned, into optimisers of the same variables."""
    for owner, opt in optimisers.items():
        restored = {}
        for key, leaf in _leaves(opt.state):
            restored[key] = like(dr.detach(leaf), arrays[f"{owner}/{key}"])
        for key in list(opt.state):
            value, *rest = _rebuilt(key, opt.state[key], restored)
            dr.enable_grad(value)
            opt.state[key] = (value, *rest)


def _leaves(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All arrays in nested dicts and tuples, by path."""
    if isinstance(node, Mapping):
        for key, child in node.items():
            yield from _leaves(child, f"{name}.{key}" if name else key)
    elif isinstance(node, (tuple, list)):
        for k, child in enumerate(node):
            yield from _leaves(child, f"{name}.{k}")
    elif dr.is_array_v(node):
        yield name, node


def _rebuilt(name: str, node: Any, leaves: Mapping[str, Any]) -> Any:
    """The same nesting with other arrays."""
    if isinstance(node, (tuple, list)):
        return tuple(_rebuilt(f"{name}.{k}", child, leaves) for k, child in enumerate(node))
    return leaves[name] if dr.is_array_v(node) else node
